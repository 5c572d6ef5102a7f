"""From agents and their evaluations to the page: which episodes to show, and the ways of the arm in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from greenhouse_gym.agents import Agent
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.errors import GreenhouseError, InvalidValueError
from greenhouse_gym.evaluation import retrace
from greenhouse_gym.evaluation.leaderboard import TRACKS, V1, Entry, Protocol, follows, is_current
from greenhouse_gym.evaluation.records import Evaluation, Record
from greenhouse_gym.reporting.comparison_figures import colors_of
from greenhouse_gym.reporting.comparison_page import Shown, comparison_page
from greenhouse_gym.reporting.scene_page import Episode, Motion
from greenhouse_gym.scene import SceneBank

EPISODES = 4
RULE = (
    "These are the episodes that divide the agents most evenly into those that succeed and those that fail; of equal "
    "ones, those of the first seeds. Each was played again for this page, with the same seeds."
)
_STILL = " Plants are drawn as they were scanned, not as they moved since."


def telling_episodes(evaluations: Sequence[Evaluation], count: int = EPISODES) -> list[Record]:
    """The episodes to show by `RULE`, among those that all agents played: the first agent's records of them."""
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
    """The page about agents, with episodes of the first track played again.

    Args:
        title: Its heading.
        tracks: Per track the agents' evaluations.
        agents: Those whose episodes to show, by their names in the evaluations; none shows no episodes.
        split: The split that they were evaluated on.
        bank: Its bank.
        notes: What else there is to say.
        **options: Further keywords of `greenhouse_gym.evaluation.retrace`, without those of the tracks.
    """
    opened = SceneBank.open(bank)
    seeds = sorted({r.seed for evaluations in tracks.values() for e in evaluations for r in e.records})
    told = f"Bank {opened.manifest.name} (its manifest has the checksum {opened.sha256[:12]}), split {split}"
    if seeds:
        told += f", seeds {seeds[0]} to {seeds[-1]}"
    track, evaluations = next(iter(tracks.items()))
    playing = [e for e in evaluations if e.records and e.agent in agents]
    colors = colors_of([e.agent for es in tracks.values() for e in es])
    shown = shown_episodes(playing, agents, split, opened, track, colors, **options)
    rule = f"Track {track}. {RULE}" + (_STILL if track == "moved" else "")
    return comparison_page(title, tracks, colors, [f"{told}.", *notes], rule, shown)


def leaderboard_report(entries: Sequence[Entry], rules: Protocol = V1) -> str:
    """The page about those entries of a leaderboard that were played on the present bank, by the rules given.

    Raises:
        InvalidValueError: There are none.
    """
    chosen = [entry for entry in entries if follows(entry, rules) and is_current(entry)]
    if not chosen:
        raise InvalidValueError("every entry is a trial or was played on an earlier bank: there is nothing to report")
    tracks = {track: [e.evaluation(track) for e in chosen if track in e.tracks] for track in TRACKS}
    agents, notes = {}, [f"{entry.agent}: {entry.note}" for entry in chosen if entry.note]
    for entry in chosen:
        try:
            agents[entry.agent] = make_agent(entry.agent)
        except GreenhouseError as error:
            notes.append(f"{entry.agent} is not shown in three dimensions: {error}")
    return comparison_report(
        f"Leaderboard, protocol {rules.version}",
        {track: evaluations for track, evaluations in tracks.items() if evaluations},
        agents,
        rules.split,
        rules.bank,
        notes,
        difficulty=rules.difficulty,
        timeout=rules.timeout,
    )


def shown_episodes(
    evaluations: Sequence[Evaluation],
    agents: Mapping[str, Agent],
    split: str,
    bank: SceneBank,
    track: str,
    colors: Mapping[str, str],
    **options: Any,
) -> list[Shown]:
    """Play the telling episodes of a track again, and gather the ways of the arm in them.

    Agents that drive another arm than the first one are left out, for a scene shows one arm.
    """
    chosen = telling_episodes(evaluations) if evaluations else []
    if not chosen:
        return []
    seeds = [record.seed for record in chosen]
    options |= {"bank": bank, **TRACKS[track]}
    ways = {e.agent: retrace(agents[e.agent], seeds, split, **options) for e in evaluations}
    robot = next(iter(ways.values()))[0].robot
    ways = {agent: traces for agent, traces in ways.items() if traces[0].robot.name == robot.name}
    before = {e.agent: {r.seed: r for r in e.records} for e in evaluations}

    def shown(k: int, record: Record) -> Shown:
        traces = {agent: of[k] for agent, of in ways.items()}
        told = {agent: _outcome(trace.record, before[agent][record.seed]) for agent, trace in traces.items()}
        motions = tuple(Motion(a, trace.joints, _rgb(colors[a]), told[a]) for a, trace in traces.items())
        where = f"scene {record.scene}, tomato {record.target} ({record.difficulty})"
        return Shown(
            f"Seed {record.seed}: {where}",
            bank.scene(record.scene),
            robot,
            Episode(f"Seed {record.seed}", record.target, motions, track != "reconstruction"),
        )

    return [shown(k, record) for k, record in enumerate(chosen)]


def _outcome(now: Record, before: Record) -> str:
    """What came of an episode, and whether that was so before."""
    if now.failure:
        told = f"gave up after {now.steps} actions: {now.failure}"
    elif now.success:
        told = f"reached it after {now.steps} actions"
    elif now.collision:
        told = f"hit {now.contact[-1]} with its {now.contact[0]} after {now.steps} actions"
    else:
        told = f"ended {100 * now.distance:.0f} cm from it after {now.steps} actions"
    return told if now.success == before.success else f"{told}, unlike before"


def _rgb(color: str) -> tuple[float, float, float]:
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red / 255, green / 255, blue / 255
