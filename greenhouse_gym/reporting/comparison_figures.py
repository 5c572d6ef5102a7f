"""Plots and tables about agents on the same episodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from greenhouse_gym.common.tables import Table
from greenhouse_gym.envs.actions import INTERVAL
from greenhouse_gym.evaluation.records import Evaluation, Record, pairings
from greenhouse_gym.reporting.plots import fractions, hover, logarithmic

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLORS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#222222", "#7b3294", "#8c510a", "#66a61e",
)  # fmt: skip
"""Distinct to most eyes; the first six and black are those of Okabe and Ito."""

_MARGIN = 1.15  # factor at both ends of an axis of times
_MIN_TIME = 1e-6  # s, shown for shorter times: the axis is logarithmic


def colors_of(agents: Sequence[str]) -> dict[str, str]:
    """Assign each agent a color; from the eleventh agent on they repeat."""
    return {agent: _COLORS[k % len(_COLORS)] for k, agent in enumerate(dict.fromkeys(agents))}


def first_motion(record: Record) -> float:
    """Return the seconds until the first action is known."""
    return record.planning_time + record.action_time


def obstacle_kind(record: Record) -> str:
    """Return the kind of obstacle in a collision."""
    kind, _, rest = record.contact[-1].partition("_")
    if kind == "stem":
        return f"{rest.partition('_')[2] or 'other'} stem"
    return kind if kind in ("tomato", "clutter", "floor", "cart") else "the arm itself"


def arm_part(record: Record) -> str:
    """Return the part of the arm that collided."""
    return record.contact[0]


# -- plots ------------------------------------------------------------------------------------------------------------


def draw_success_rates(axes: Axes, groups: Mapping[str, Sequence[Evaluation]], colors: Mapping[str, str]) -> None:
    """Draw success rates with their 95 % intervals, the agents next to each other within each group."""
    for k, (agent, color) in enumerate(colors.items()):
        shift = 0.7 * ((k + 0.5) / len(colors) - 0.5)
        for x, (group, evaluations) in enumerate(groups.items()):
            for e in (e for e in evaluations if e.agent == agent and e.records):
                low, high = e.success_interval
                axes.vlines(x + shift, low, high, color, linewidth=1.5)
                (dot,) = axes.plot(x + shift, e.success_rate, "o", color=color)
                hover(dot, f"{agent}, {group}: {e.success_rate:.1%} of {len(e.records)}")
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.set_xticks(range(len(groups)), list(groups))
    axes.grid(axis="x", visible=False)
    fractions(axes, "successful episodes")


class Curve(NamedTuple):
    """A plot of the fraction of episodes in which something had happened.

    Attributes:
        caption: Caption of the plot.
        label: Label of the horizontal axis.
        value: Returns the value of the horizontal axis at which it happened in an episode.
        happened: Returns whether it happened in an episode.
        over_time: The horizontal axis shows time and is logarithmic.
    """

    caption: str
    label: str
    value: Callable[[Record], float]
    happened: Callable[[Record], bool]
    over_time: bool = True

    def draw(self, axes: Axes, evaluations: Sequence[Evaluation], colors: Mapping[str, str]) -> None:
        """Draw the stairs of each agent."""
        lowest = _MIN_TIME if self.over_time else 0.0
        values = {
            e.agent: sorted(max(lowest, self.value(r)) for r in e.records if self.happened(r)) for e in evaluations
        }
        if self.over_time:
            times = list(chain(*values.values())) or [1.0]
            logarithmic(axes, min(times) / _MARGIN, max(times) * _MARGIN)
        else:
            axes.set_xlim(0, max([1.0, *(self.value(r) for e in evaluations for r in e.records)]))
        low, high = axes.get_xlim()
        for e in (e for e in evaluations if e.records):
            heights = np.arange(len(values[e.agent]) + 1) / len(e.records)
            x, y = [low, *values[e.agent], high], [*heights, heights[-1]]
            (line,) = axes.step(x, y, where="post", color=colors[e.agent])
            hover(line, f"{e.agent}: {heights[-1]:.1%}")
        axes.set_xlabel(self.label)
        fractions(axes, "episodes")


SUCCESSES_BY_ACTIONS = Curve(
    "Fraction of all episodes that succeeded within a number of actions.",
    "actions",
    lambda r: r.steps,
    lambda r: r.success,
    over_time=False,
)
SUCCESSES_BY_TIME = Curve(
    "The same over time: planning before the first action, then 20 actions a second, or fewer for agents that take "
    "longer to choose one.",
    "seconds, planning included",
    lambda r: r.planning_time + r.steps * max(INTERVAL, r.action_time),
    lambda r: r.success,
)
FIRST_MOTIONS = Curve(
    "Fraction of all episodes in which the first action was known.",
    "seconds to the first motion",
    first_motion,
    lambda r: r.steps > 0,
)


# -- tables -----------------------------------------------------------------------------------------------------------


def first_motion_table(evaluations: Sequence[Evaluation]) -> Table:
    """Return quantiles of the time until the arm moves, milliseconds."""
    rows = []
    for e in evaluations:
        times = [1e3 * first_motion(r) for r in e.records if FIRST_MOTIONS.happened(r)]
        if times:
            rows.append((e.agent, *map(_milliseconds, np.quantile(times, (0.5, 0.9, 1.0)))))
    return Table(("agent", "median ms", "90 % within ms", "longest ms"), rows)


def _milliseconds(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.2g}"


def pairs_table(evaluations: Sequence[Evaluation]) -> Table:
    """Return McNemar's test of every two agents: how often one alone succeeded, and the p-value of that difference."""
    rows = []
    for p in pairings(evaluations):
        better = p.first if p.only_first > p.only_second else p.second
        verdict = f"{better} is better" if p.p_value < 0.05 else "may be equally good"
        alone = (f"{p.only_first} of {p.episodes}", f"{p.only_second} of {p.episodes}")
        rows.append((p.first, p.second, *alone, f"{p.p_value:.2g}", verdict))
    heads = ("first", "second", "only first succeeded", "only second succeeded", "p", "verdict")
    return Table(heads, rows, words=(0, 1, 5))


def collision_table(head: str, evaluations: Sequence[Evaluation], kind: Callable[[Record], str]) -> Table:
    """Count each agent's collisions of each kind, the most frequent kind first."""
    counts = {e.agent: Counter(kind(r) for r in e.records if r.collision and r.contact) for e in evaluations}
    total = sum(counts.values(), Counter[str]())
    kinds = sorted(total, key=lambda name: (-total[name], name))
    rows = [(name, *(str(counts[e.agent][name] or "") for e in evaluations)) for name in kinds]
    return Table((head, *(e.agent for e in evaluations)), rows)
