"""Commands that compare agents: compare, submit, leaderboard."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from greenhouse_gym.cli.options import (
    Address,
    AgentArgument,
    AgentArguments,
    AgentRobot,
    Backend,
    Bank,
    Difficulty,
    NumEnvs,
    OneScene,
    OneTarget,
    Seed,
    Split,
    Workers,
    comma_separated,
    executor_of,
    given,
)
from greenhouse_gym.common.progress import say

if TYPE_CHECKING:
    from greenhouse_gym.agents.agent import Agent
    from greenhouse_gym.evaluation import Evaluation
    from greenhouse_gym.evaluation.journal import RecordJournal
    from greenhouse_gym.evaluation.leaderboard import Entry, Protocol

ENTRIES = Path("benchmarks/leaderboard")
"""Folder of the leaderboard's entries in the repository."""

# Paths that are written after an agent ran are absolute: it may change the working folder.
EntryFolder = Annotated[
    Path | None,
    typer.Option("--out", resolve_path=True, help=f"Folder of the entries; {ENTRIES} by default, where that exists."),
]
ReportFile = Annotated[
    Path | None,
    typer.Option("--report", resolve_path=True, help="HTML file for tables, plots and episodes in 3-D, all in one."),
]

_SUCCESS = ("agent", "success [95 %]", "easy", "medium", "hard", "unreachable", "collision")
_MOTION = ("agent", "planning s", "steps", "joints rad", "tip m", "clearance mm")

_RANKING = ("agent", "knows", "success [95 %]", "collision", "first ms", "action ms")


def compare(
    names: AgentArguments = None,
    bank: Bank = "default",
    split: Split = "test",
    episodes: Annotated[int, typer.Option(help="Episodes of each agent.")] = 100,
    seed: Seed = 0,
    robot: AgentRobot = "",
    task: Annotated[
        str, typer.Option(help="Task: look, or your own as file.py:Class or module:Class; reach by default.")
    ] = "",
    scene: OneScene = None,
    target: OneTarget = None,
    difficulty: Difficulty = "",
    track: Annotated[
        str,
        typer.Option(help="Worlds, separated by commas: reconstruction, truth, moved, brush, or harvest for its task."),
    ] = "reconstruction",
    num_envs: NumEnvs = 1,
    timeout: Annotated[float, typer.Option(help="Timeout of one answer of an agent, seconds.")] = 120.0,
    report: ReportFile = None,
    backend: Backend = None,
    workers: Workers = None,
    address: Address = "local",
) -> None:
    """Run agents on the same episodes and print their success and their motions.

    By default these are a planner, the shipped policy and a random agent. The line below the tables states which of
    them differ by more than chance, by McNemar's test on the same episodes. Lengths, steps and clearances are medians
    over the successful episodes.

    An interrupted run prints the tables of the agents that have finished. With a report, the same command resumes it:
    the folder REPORT.journal holds the episodes until the report is complete. The work runs in several processes only
    on request, because parallel processes distort each other's times. For the report, a few episodes are run again at
    the end.
    """
    from dataclasses import replace

    from greenhouse_gym.agents.named import make_agent
    from greenhouse_gym.agents.policy_agent import BEST
    from greenhouse_gym.common.files import exclusive, remove_folder
    from greenhouse_gym.errors import require_choice
    from greenhouse_gym.evaluation import compare as run
    from greenhouse_gym.evaluation.journal import journal_in
    from greenhouse_gym.evaluation.leaderboard import TRACKS

    requested = names or ["RRTConnect", BEST, "random"]
    tracks = [require_choice("track", name, TRACKS) for name in comma_separated(track)]
    made = {name: make_agent(name) for name in requested}
    alike = len({agent.name for agent in made.values()}) < len(made)
    made_from = {name if alike else agent.name: name for name, agent in made.items()}
    chosen = {label: made[name] for label, name in made_from.items()}
    shared: dict[str, Any] = {"timeout": timeout}
    shared |= given(robot=robot, task=task, difficulty=comma_separated(difficulty), scene=scene, target=target)
    rules = {name: {"bank": bank, "split": split, "seed": seed, **TRACKS[name], **shared} for name in tracks}
    folder = None if report is None else report.with_name(f"{report.name}.journal")
    if report is not None:
        _require_report(report)
    with nullcontext() if folder is None else exclusive(folder):
        journals: dict[tuple[str, str], RecordJournal] = {}
        if folder is not None:
            for name, (label, agent) in product(tracks, chosen.items()):
                journals[name, label] = journal_in(folder, agent, made_from[label], **rules[name])
        finished: dict[str, list[Evaluation]] = {}
        complete = False
        try:
            for name in tracks:
                evaluations = finished[name] = []
                try:
                    with executor_of(backend, workers, address) as executor:
                        for label, agent in chosen.items():
                            spread: dict[str, Any] = {
                                "num_envs": num_envs,
                                "executor": executor,
                                "journal": journals.get((name, label)),
                            }
                            (found,) = run([agent], episodes=episodes, **rules[name], **spread)
                            evaluations.append(replace(found, agent=label))
                finally:
                    if evaluations:
                        say(f"track {name}: bank {bank}, split {split}, {episodes} episodes from seed {seed} on\n")
                        print_comparison(evaluations)
            complete = True
        finally:
            results = {name: found for name, found in finished.items() if any(e.records for e in found)}
            if report is not None and folder is not None and results:
                _write_report(report, results, chosen, complete, split, bank, **shared)
                if complete:
                    remove_folder(folder)
                say(f"report in {report}")


def _write_report(
    path: Path,
    results: Mapping[str, Sequence[Evaluation]],
    agents: Mapping[str, Agent],
    complete: bool,
    split: str,
    bank: str | Path,
    **options: Any,
) -> None:
    """Write a report by track, with some episodes run again if it is complete."""
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.reporting.comparison import comparison_report

    title = f"Comparison of {', '.join(agents)}"
    # without episodes first: running them again may fail or take long
    for shown in ({}, agents) if complete else ({},):
        write_atomically(path, comparison_report(title, results, shown, split, bank, **options))


def _require_report(path: Path) -> None:
    """Raise an error if a report cannot be drawn or written, before the episodes are run for it."""
    import greenhouse_gym.reporting.plots  # noqa: F401  # which needs matplotlib
    from greenhouse_gym.common.files import require_writable

    require_writable(path)


def print_comparison(evaluations: Sequence[Evaluation]) -> None:
    """Print the success and the motions of agents, and how they differ."""
    from greenhouse_gym.evaluation.harvest import harvest_rows, is_harvest
    from greenhouse_gym.evaluation.records import comparison_notes, comparison_rows, differences

    if is_harvest(evaluations):
        harvest_rows(evaluations).show()
    else:
        rows = comparison_rows(evaluations)
        rows.only(*_SUCCESS).show()
        say("")
        rows.only(*_MOTION).show()
    for note in (*comparison_notes(evaluations), differences(evaluations)):
        say(f"\n{note}" if note else "")


def submit(
    agent: AgentArgument,
    out: EntryFolder = None,
    track: Annotated[
        str,
        typer.Option(
            help="Tracks, separated by commas: reconstruction, truth, moved, brush; harvest. By default all those of "
            "the agent's task."
        ),
    ] = "",
    episodes: Annotated[
        int, typer.Option(min=1, help="A number other than the protocol's makes a trial, which is not ranked.")
    ] = 1000,
    num_envs: NumEnvs = 1,
    note: Annotated[str, typer.Option(help="A remark, such as how the agent was trained.")] = "",
    backend: Backend = None,
    workers: Workers = None,
    address: Address = "local",
) -> None:
    """Run the episodes of protocol v2 and write an entry of the leaderboard (docs/results/leaderboard.md).

    Tracks of an existing entry of the same agent, bank and versions are kept. A trial has its own file,
    AGENT.trial.json. An interrupted run resumes from AGENT.TRACK.jsonl, which holds the records of a track until all
    its episodes are done.

    The work runs in several processes only on request: the results are the same, but episodes and processes that run at
    once distort each other's times.
    """
    from dataclasses import replace

    from greenhouse_gym.agents.named import make_agent
    from greenhouse_gym.evaluation.leaderboard import CURRENT, read_entry
    from greenhouse_gym.evaluation.leaderboard import submit as run

    folder = _entry_folder(out)
    player, rules = make_agent(agent), replace(CURRENT, episodes=episodes)
    with executor_of(backend, workers, address) as executor:
        path = run(player, agent, folder, comma_separated(track) or None, rules, num_envs, note, executor)
    _print_leaderboard([read_entry(path)], rules)
    say(f"{'entry' if rules == CURRENT else 'trial'} in {path}")


def _entry_folder(out: Path | None) -> Path:
    """Return the folder of entries: the given one, or that of the repository in the working folder.

    Raises:
        InvalidValueError: No folder is given, and this is not the repository.
    """
    from greenhouse_gym.errors import InvalidValueError

    if out is None and not ENTRIES.is_dir():
        raise InvalidValueError(f"name the folder of the entries: there is no {ENTRIES} in {Path.cwd()}")
    return out or ENTRIES


def _print_leaderboard(entries: Sequence[Entry], rules: Protocol) -> None:
    from greenhouse_gym.evaluation.entry import HARVEST
    from greenhouse_gym.evaluation.leaderboard import leaderboard_notes, leaderboard_tables

    for track, table in leaderboard_tables(entries, rules).items():
        say(f"track {track}\n")
        (table if track == HARVEST else table.only(*_RANKING)).show()
        say("")
    for note in leaderboard_notes(entries, rules):
        say(note)


def leaderboard(
    folder: Annotated[
        Path | None, typer.Argument(help=f"Folder of the entries; {ENTRIES} by default.", show_default=False)
    ] = None,
    report: ReportFile = None,
) -> None:
    """Print the tables of all entries of a folder, track by track."""
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.errors import FileFormatError
    from greenhouse_gym.evaluation.leaderboard import CURRENT, read_entry

    folder = _entry_folder(folder)
    entries = [read_entry(path) for path in sorted(folder.glob("*.json"))]
    if not entries:
        raise FileFormatError(folder, "holds no entry; `greenhouse-gym submit` writes one")
    _print_leaderboard(entries, CURRENT)
    if report is not None:
        from greenhouse_gym.reporting.comparison import leaderboard_report

        write_atomically(report, leaderboard_report(entries))
        say(f"report in {report}")
