"""The page about agents and their evaluations, with a few episodes that are run again for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from greenhouse_gym.agents import Agent
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.common.progress import progress
from greenhouse_gym.errors import GreenhouseError, InvalidValueError
from greenhouse_gym.evaluation import retrace
from greenhouse_gym.evaluation.entry import HARVEST
from greenhouse_gym.evaluation.harvest import harvest_rows, is_harvest
from greenhouse_gym.evaluation.leaderboard import CURRENT, TRACKS, Entry, Protocol, difficulty_of, follows, is_current
from greenhouse_gym.evaluation.records import Evaluation, Record, comparison_notes, comparison_rows, difficulties_of
from greenhouse_gym.reporting import comparison_figures as figures
from greenhouse_gym.reporting.comparison_figures import colors_of
from greenhouse_gym.reporting.film import outcome
from greenhouse_gym.reporting.pages import render
from greenhouse_gym.reporting.plots import svg_plot
from greenhouse_gym.reporting.scene_page import Motion, Replay, scene_page
from greenhouse_gym.scene import SceneBank

_WORLDS = {
    "reconstruction": "Agents know the reconstruction, and their contacts are with it.",
    "truth": "Agents know the reconstruction; their contacts are with the scanned row.",
    "moved": "Agents know the reconstruction; their contacts are with the scanned row, after its plants moved.",
    "brush": "Agents know the reconstruction; their contacts are with the scanned row, whose leaves give way.",
    HARVEST: "Agents harvest stands of the scanned row, whose plants give way.",
}

EPISODES = 4
RULE = (
    "The episodes that divide the agents most evenly into successes and failures; among equals, those with the lowest "
    "seeds. Each was run again for this page, with the same seed."
)
_PLANTS_AT_REST = " Plants are drawn where they were scanned, not where they moved."


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


def dividing_episodes(evaluations: Sequence[Evaluation], count: int = EPISODES) -> list[Record]:
    """Return the episodes to show by `RULE`, among those that all agents ran: the first agent's records of them."""
    first, *others = ({r.seed: r for r in e.records} for e in evaluations)
    shared = [seed for seed in first if all(seed in other for other in others)]

    def evenness(seed: int) -> int:
        successes = sum(records[seed].success for records in (first, *others))
        return min(successes, 1 + len(others) - successes)

    return [first[seed] for seed in sorted(shared, key=lambda seed: (-evenness(seed), seed))[:count]]


def comparison_report(
    title: str,
    tracks: Mapping[str, Sequence[Evaluation]],
    agents: Mapping[str, Agent],
    split: str,
    bank: str | Path,
    notes: Sequence[str] = (),
    **options: Any,
) -> str:
    """Return the page about agents, with some episodes of the first track run again.

    Args:
        title: Heading of the page.
        tracks: The agents' evaluations by track.
        agents: Agents whose episodes to show, by their names in the evaluations; without any, no episodes are shown.
        split: Split of the evaluations.
        bank: Bank of the evaluations.
        notes: Further paragraphs.
        **options: Further keywords of `greenhouse_gym.evaluation.retrace`, except those of the tracks.
    """
    opened = SceneBank.open(bank)
    seeds = sorted({r.seed for evaluations in tracks.values() for e in evaluations for r in e.records})
    source = f"Bank {opened.manifest.name} (checksum of its manifest: {opened.sha256[:12]}), split {split}"
    if seeds:
        source += f", seeds {seeds[0]} to {seeds[-1]}"
    track, evaluations = next(iter(tracks.items()))
    shown = [e for e in evaluations if e.records and e.agent in agents]
    colors = colors_of([e.agent for es in tracks.values() for e in es])
    moving = TRACKS[track].get("plants") == "compliant"  # a scene page shows plants at rest
    episodes = _episode_pages(shown, agents, split, opened, track, colors, **options) if shown and not moving else []
    rule = f"Track {track}. {RULE}" + (_PLANTS_AT_REST if track == "moved" else "")
    return comparison_page(title, tracks, colors, [f"{source}.", *notes], rule, episodes)


def leaderboard_report(entries: Sequence[Entry], rules: Protocol = CURRENT) -> str:
    """Return the page about those entries of a leaderboard that follow the given rules on the current bank.

    Raises:
        InvalidValueError: No entry does.
    """
    chosen = [entry for entry in entries if follows(entry, rules) and is_current(entry)]
    if not chosen:
        raise InvalidValueError("nothing to report: every entry is a trial or was run on an earlier bank")
    tracks = {track: [e.evaluation(track) for e in chosen if track in e.tracks] for track in TRACKS}
    agents, notes = {}, [f"{entry.agent}: {entry.note}" for entry in chosen if entry.note]
    for entry in chosen:
        try:
            agents[entry.agent] = make_agent(entry.agent)
        except GreenhouseError as error:
            notes.append(f"{entry.agent} is not shown in 3-D: {error}")
    tracks = {track: evaluations for track, evaluations in tracks.items() if evaluations}
    return comparison_report(
        f"Leaderboard, protocol {rules.version}",
        tracks,
        agents,
        rules.split,
        rules.bank,
        notes,
        difficulty=difficulty_of(rules, next(iter(tracks))),
        timeout=rules.timeout,
        start=rules.start,
    )


def _episode_pages(
    evaluations: Sequence[Evaluation],
    agents: Mapping[str, Agent],
    split: str,
    bank: SceneBank,
    track: str,
    colors: Mapping[str, str],
    **options: Any,
) -> list[tuple[str, str]]:
    """Run the dividing episodes of a track again and return heading and scene page of each.

    Agents that drive another arm than the first agent are left out: a scene page shows one arm.
    """
    chosen = dividing_episodes(evaluations)
    seeds = [record.seed for record in chosen]
    options |= {"bank": bank, **TRACKS[track]}
    traces = {}
    with progress("agents whose episodes are run again for the report", len(evaluations)) as on_progress:
        for e in evaluations:
            traces[e.agent] = retrace(agents[e.agent], seeds, split, **options)
            on_progress(len(traces))
    robot = next(iter(traces.values()))[0].robot
    before = {e.agent: {r.seed: r for r in e.records} for e in evaluations}
    pages = []
    for k, record in enumerate(chosen):
        motions = tuple(
            Motion(agent, of[k].joints, _rgb(colors[agent]), _outcome(of[k].record, before[agent][record.seed]))
            for agent, of in traces.items()
            if of[k].robot.name == robot.name
        )
        title = f"Seed {record.seed}"
        replay = Replay(title, record.target, motions, in_truth=track != "reconstruction")
        page = scene_page(bank.scene(record.scene), robot, replay)
        pages.append((f"{title}: scene {record.scene}, tomato {record.target} ({record.difficulty})", page))
    return pages


def _outcome(now: Record, before: Record) -> str:
    """Describe how an episode ended, and whether it ended differently before."""
    text = outcome(now.success, now.collision, now.contact, now.steps, now.distance, now.failure, now.measures)
    return text if now.success == before.success else f"{text}, unlike before"


def _rgb(color: str) -> tuple[float, float, float]:
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red / 255, green / 255, blue / 255
