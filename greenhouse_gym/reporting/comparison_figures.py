"""Plots and tables about agents on the same episodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from greenhouse_gym.envs.actions import INTERVAL
from greenhouse_gym.evaluation.records import Evaluation, Record, pairing
from greenhouse_gym.geometry import Array
from greenhouse_gym.reporting import pieces
from greenhouse_gym.reporting.svg import Axis, Series, plot

_COLORS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#222222", "#7b3294", "#8c510a", "#66a61e",
)  # fmt: skip
"""Told apart by most eyes; the first eight are those of Okabe and Ito, but for their yellow."""

_WIDTH, _HEIGHT = 460, 260
_EDGE = 1.15  # factor of room at both ends of an axis of times
_NO_TIME = 1e-6  # seconds, the least that an axis of times shows


def colors_of(agents: Sequence[str]) -> dict[str, str]:
    """A color for each agent, from the eleventh on in turn again."""
    return {agent: _COLORS[k % len(_COLORS)] for k, agent in enumerate(dict.fromkeys(agents))}


def rates_plot(title: str, groups: Mapping[str, Sequence[Evaluation]], colors: Mapping[str, str]) -> str:
    """Success rates with their 95 % intervals, agents beside each other within each group."""
    series = []
    for k, (agent, color) in enumerate(colors.items()):
        shift = 0.7 * ((k + 0.5) / len(colors) - 0.5)
        found = [(g, e) for g, es in enumerate(groups.values()) for e in es if e.agent == agent and e.records]
        points = np.array([(g + shift, e.success_rate) for g, e in found]).reshape(-1, 2)
        spans = np.array([e.success_interval for _, e in found]).reshape(-1, 2)
        names = [f"{agent}, {list(groups)[g]}: {e.success_rate:.1%} of {len(e.records)}" for g, e in found]
        series.append(Series(points, "dots", names, color=color, spans=spans))
    across = Axis("", -0.5, len(groups) - 0.5, names=tuple(groups))
    return plot(title, across, _SHARE, series, _WIDTH, _HEIGHT)


def steps_plot(evaluations: Sequence[Evaluation], colors: Mapping[str, str]) -> str:
    """Which share of the episodes had succeeded after how many actions."""
    most = max((r.steps for e in evaluations for r in e.records), default=1)
    return _shares("successes by actions", Axis("actions", 0.0, max(1, most)), evaluations, colors, lambda r: r.steps)


def seconds_plot(evaluations: Sequence[Evaluation], colors: Mapping[str, str]) -> str:
    """Which share of the episodes had succeeded after how many seconds, thought before the first action included."""
    return _timed("successes by time", "seconds, thought included", evaluations, colors, _ended, lambda r: r.success)


def motion_plot(evaluations: Sequence[Evaluation], colors: Mapping[str, str]) -> str:
    """In which share of the episodes the arm had begun to move after how many seconds."""
    return _timed("begun by time", "seconds to the first motion", evaluations, colors, first_motion, _acted)


def motion_table(evaluations: Sequence[Evaluation]) -> str:
    """How long agents take until the arm moves, milliseconds."""
    rows = []
    for e in evaluations:
        times = [1e3 * first_motion(r) for r in e.records if _acted(r)]
        if times:
            rows.append((e.agent, *map(_milliseconds, np.quantile(times, (0.5, 0.9, 1.0)))))
    return pieces.table(("agent", "median ms", "90 % within ms", "longest ms"), rows, {0})


def pairs_table(evaluations: Sequence[Evaluation]) -> str:
    """McNemar's test between any two agents: who succeeded alone, how often, and how likely that is by chance."""
    played = [e for e in evaluations if e.records]
    rows = []
    for k, first in enumerate(played):
        for second in played[k + 1 :]:
            p = pairing(first, second)
            better = p.first if p.only_first > p.only_second else p.second
            verdict = f"{better} is better" if p.p_value < 0.05 else "may be equally good"
            alone = (f"{p.only_first} of {p.episodes}", f"{p.only_second} of {p.episodes}")
            rows.append((first.agent, second.agent, *alone, f"{p.p_value:.2g}", verdict))
    heads = ("first", "second", "only first succeeded", "only second succeeded", "p", "verdict")
    return pieces.table(heads, rows, {0, 1, 5})


def collision_tables(evaluations: Sequence[Evaluation]) -> str:
    """What agents touch, and with which part of the arm."""
    of: tuple[tuple[str, Callable[[Record], str]], ...] = (("what is touched", touched), ("what touches it", toucher))
    return "".join(_counted(name, evaluations, kind) for name, kind in of)


def first_motion(record: Record) -> float:
    """Seconds until the first action is known."""
    return record.planning_time + record.action_time


def touched(record: Record) -> str:
    """Of which kind the obstacle of a collision is."""
    kind, _, rest = record.contact[-1].partition("_")
    if kind == "stem":
        return f"{rest.partition('_')[2] or 'other'} stem"
    return kind if kind in ("tomato", "clutter", "floor", "cart") else "the arm itself"


def toucher(record: Record) -> str:
    """Which part of the arm collided."""
    return record.contact[0]


_SHARE = Axis("share of the episodes", 0.0, 1.0)


def _milliseconds(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.2g}"


def _acted(record: Record) -> bool:
    return record.steps > 0


def _ended(record: Record) -> float:
    return record.planning_time + record.steps * max(INTERVAL, record.action_time)


def _timed(
    title: str,
    label: str,
    evaluations: Sequence[Evaluation],
    colors: Mapping[str, str],
    time: Callable[[Record], float],
    counts: Callable[[Record], bool],
) -> str:
    times = [max(_NO_TIME, time(r)) for e in evaluations for r in e.records if counts(r)] or [1.0]
    across = Axis(label, min(times) / _EDGE, max(times) * _EDGE, log=True)
    return _shares(title, across, evaluations, colors, lambda r: max(_NO_TIME, time(r)), counts)


def _shares(
    title: str,
    across: Axis,
    evaluations: Sequence[Evaluation],
    colors: Mapping[str, str],
    value: Callable[[Record], float],
    counts: Callable[[Record], bool] = lambda record: record.success,
) -> str:
    """Stairs: the share of an agent's episodes that count and whose value is at most that on the axis."""
    series = []
    for e in evaluations:
        if e.records:
            values = np.sort([value(r) for r in e.records if counts(r)])
            points = _stairs(values, len(e.records), across)
            series.append(Series(points, "line", (f"{e.agent}: {points[-1, 1]:.1%}",), color=colors[e.agent]))
    return plot(title, across, _SHARE, series, _WIDTH, _HEIGHT)


def _stairs(values: Array, episodes: int, across: Axis) -> Array:
    shares = np.arange(len(values) + 1) / episodes
    at = np.concatenate([[across.low], np.repeat(values, 2), [across.high]])
    return np.column_stack([at, np.repeat(shares, 2)])


def _counted(head: str, evaluations: Sequence[Evaluation], kind: Callable[[Record], str]) -> str:
    counts = {e.agent: Counter(kind(r) for r in e.records if r.collision and r.contact) for e in evaluations}
    total = sum(counts.values(), Counter())
    kinds = [name for name, _ in sorted(total.items(), key=lambda item: (-item[1], item[0]))]

    def rows() -> Iterator[tuple[str, ...]]:
        for name in kinds:
            yield (name, *(str(counts[e.agent][name] or "") for e in evaluations))

    return pieces.table((head, *(e.agent for e in evaluations)), rows(), {0})
