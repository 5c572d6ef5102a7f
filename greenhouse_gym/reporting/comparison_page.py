"""A comparison of agents on one page: tables, plots, and episodes in 3-D."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from greenhouse_gym.evaluation.entry import HARVEST
from greenhouse_gym.evaluation.harvest import harvest_rows, is_harvest
from greenhouse_gym.evaluation.records import Evaluation, comparison_notes, comparison_rows, difficulties_of
from greenhouse_gym.reporting import comparison_figures as figures
from greenhouse_gym.reporting.pages import render
from greenhouse_gym.reporting.plots import svg_plot

_WORLDS = {
    "reconstruction": "Agents know the reconstruction, and their contacts are with it.",
    "truth": "Agents know the reconstruction; their contacts are with the scanned row.",
    "moved": "Agents know the reconstruction; their contacts are with the scanned row, after its plants moved.",
    "brush": "Agents know the reconstruction; their contacts are with the scanned row, whose leaves give way.",
    HARVEST: "Agents harvest stands of the scanned row, whose plants give way.",
}


def comparison_page(
    title: str,
    tracks: Mapping[str, Sequence[Evaluation]],
    colors: Mapping[str, str],
    notes: Sequence[str] = (),
    rule: str = "",
    episodes: Sequence[tuple[str, str]] = (),
) -> str:
    """Return the comparison of agents on the same episodes as one HTML page, which loads nothing.

    Args:
        title: Its heading.
        tracks: The agents' evaluations by track, a key of `greenhouse_gym.evaluation.leaderboard.TRACKS`.
        colors: A color for each agent.
        notes: Paragraphs below the heading.
        rule: The rule by which the episodes were chosen.
        episodes: Heading and `scene_page` of each episode to show in 3-D.
    """
    count = max((len(e.records) for evaluations in tracks.values() for e in evaluations), default=0)
    return render(
        "comparison.html",
        title=title,
        totals={"agents": len(colors), "episodes each": f"{count:,}"},
        notes=notes,
        colors=colors,
        by_track=_plot("success by track", figures.draw_success_rates, tracks, colors) if len(tracks) > 1 else "",
        tracks=[_track(name, evaluations, colors) for name, evaluations in tracks.items()],
        rule=rule,
        episodes=episodes,
    )


def _track(name: str, evaluations: Sequence[Evaluation], colors: Mapping[str, str]) -> dict[str, Any]:
    """Return everything that the page shows of one track."""
    used = {e.agent: colors[e.agent] for e in evaluations}
    groups = {"all": evaluations}
    groups |= {difficulty: [e.of(difficulty) for e in evaluations] for difficulty in difficulties_of(evaluations)}
    rates = "Success by difficulty, with 95 % intervals (Wilson)."
    curves = (figures.SUCCESSES_BY_ACTIONS, figures.SUCCESSES_BY_TIME, figures.FIRST_MOTIONS)
    plots = [(_plot(rates, figures.draw_success_rates, groups, used), rates)]
    plots += [(_plot(curve.caption, curve.draw, evaluations, used), curve.caption) for curve in curves]
    return {
        "name": name,
        "world": _WORLDS[name],
        "harvest": harvest_rows(evaluations) if is_harvest(evaluations) else None,
        "summary": comparison_rows(evaluations),
        "warnings": comparison_notes(evaluations),
        "colors": used,
        "plots": plots,
        "first_motion": figures.first_motion_table(evaluations),
        "pairs": figures.pairs_table(evaluations),
        "collisions": (
            figures.collision_table("obstacle", evaluations, figures.obstacle_kind),
            figures.collision_table("part of the arm", evaluations, figures.arm_part),
        ),
    }


def _plot(title: str, draw: Callable[..., None], data: Any, colors: Mapping[str, str]) -> str:
    return svg_plot(title, lambda axes: draw(axes, data, colors), 460, 260)
