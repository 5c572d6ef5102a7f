"""Commands on agents: compare, submit, leaderboard, demonstrations, watch."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from greenhouse_gym.cli.acting import Bank
from greenhouse_gym.cli.acting import parts as _parts
from greenhouse_gym.cli.spread import Address, Backend, Workers, spread
from greenhouse_gym.common.progress import say

if TYPE_CHECKING:
    from greenhouse_gym.agents import Agent
    from greenhouse_gym.evaluation import Evaluation

_REPORT = "HTML file for figures, plots and episodes in 3-D, all in one."


def compare(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[AGENTS]...",
            help="Planners, policies (names or files), random, still, straight-line, resolved-rate, waypoint, depth, "
            "careful, watchful, guide, hybrid, shielded, or your own as file.py:Class or module:Class.",
        ),
    ] = None,
    agents: Annotated[str, typer.Option(help="Further agents, separated by commas.")] = "",
    bank: Bank = "default",
    split: Annotated[str, typer.Option(help="train, validation or test.")] = "test",
    episodes: Annotated[int, typer.Option(help="Episodes of each agent.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed of the first episode; the next ones count on from it.")] = 0,
    robot: Annotated[str, typer.Option(help="Name or file of the arm; by default what each agent needs.")] = "",
    difficulty: Annotated[str, typer.Option(help="Difficulties of the targets, separated by commas.")] = "",
    task: Annotated[str, typer.Option(help="Your own task as file.py:Class or module:Class; by default reach.")] = "",
    track: Annotated[
        str, typer.Option(help="What is touched, separated by commas: reconstruction, truth, moved.")
    ] = "reconstruction",
    num_envs: Annotated[int, typer.Option(help="Episodes played side by side.")] = 1,
    timeout: Annotated[float, typer.Option(help="Seconds an agent may take for one answer.")] = 120.0,
    report: Annotated[Path | None, typer.Option(help=_REPORT)] = None,
    backend: Backend = None,
    workers: Workers = None,
    address: Address = "local",
) -> None:
    """Run agents on the same episodes and print a table for each track.

    By default these are a planner, the shipped policy and a random agent. Lines below each table tell whether the
    agents differ by more than chance, by McNemar's test on the same episodes. A run that is interrupted prints the
    table of the agents it has finished. The work is spread over processes only where that is asked for, because
    processes side by side disturb each other's times. For the report, a few episodes are played again at the end.
    """
    from dataclasses import replace

    from greenhouse_gym.agents.named import make_agent
    from greenhouse_gym.agents.policy_agent import BEST
    from greenhouse_gym.common.files import require_writable, write_atomically
    from greenhouse_gym.errors import require_choice
    from greenhouse_gym.evaluation import compare as run
    from greenhouse_gym.evaluation import comparison_table
    from greenhouse_gym.evaluation.leaderboard import TRACKS
    from greenhouse_gym.evaluation.records import pairing
    from greenhouse_gym.reporting.comparison import comparison_report

    asked = [*(names or ()), *_parts(agents)] or ["RRTConnect", BEST, "random"]
    tracks = [require_choice("track", name, TRACKS) for name in _parts(track)]
    chosen = _by_name(asked, [make_agent(name) for name in asked])
    shared: dict[str, Any] = {"timeout": timeout}
    shared |= {
        key: value for key, value in (("robot", robot), ("task", task), ("difficulty", _parts(difficulty))) if value
    }
    if report is not None:
        require_writable(report)
    played: dict[str, list[Evaluation]] = {}
    again: dict[str, Agent] = {}
    try:
        for name in tracks:
            evaluations = played[name] = []
            try:
                with spread(backend, workers, address) as executor:
                    for called, agent in chosen.items():
                        options = {**shared, "bank": bank, "num_envs": num_envs, **TRACKS[name]}
                        (found,) = run([agent], split, episodes, seed, executor=executor, **options)
                        evaluations.append(replace(found, agent=called))
            finally:
                if evaluations:
                    if len(tracks) > 1:
                        typer.echo(f"\ntrack {name}\n")
                    typer.echo(comparison_table(evaluations), nl=False)
                    for first, second in combinations((e for e in evaluations if not e.error), 2):
                        typer.echo(str(pairing(first, second)))
        again = chosen
    finally:
        tracks_played = {name: found for name, found in played.items() if any(e.records for e in found)}
        if report is not None and tracks_played:
            title = f"Comparison of {', '.join(chosen)}"
            for shown in ({}, again) if again else ({},):  # first without episodes: playing them may fail or take long
                page = comparison_report(title, tracks_played, shown, split, bank, **shared)
                write_atomically(report, page)
            say(f"report in {report}")


def _by_name(asked: Sequence[str], agents: Sequence[Agent]) -> dict[str, Agent]:
    """Agents by their names, or where two have the same, as one asked for them."""
    alike = len({agent.name for agent in agents}) < len(agents)
    return dict(zip(asked if alike else (agent.name for agent in agents), agents, strict=True))


def submit(
    agent: Annotated[str, typer.Argument(help="An agent, as `compare` takes it.")],
    out: Annotated[Path, typer.Option(help="Folder of the entries.")] = Path("benchmarks/leaderboard"),
    track: Annotated[str, typer.Option(help="Tracks, separated by commas.")] = "reconstruction,truth,moved",
    episodes: Annotated[
        int, typer.Option(min=1, help="Another number than the protocol's makes a trial, which no table ranks.")
    ] = 1000,
    num_envs: Annotated[
        int, typer.Option(help="Episodes side by side; above 1, times are not those of one alone.")
    ] = 1,
    note: Annotated[str, typer.Option(help="What else there is to say, such as how it was trained.")] = "",
    backend: Backend = None,
    workers: Workers = None,
    address: Address = "local",
) -> None:
    """Play the episodes of protocol v1 and write the leaderboard's entry (docs/leaderboard.md).

    Tracks that an entry of the same agent has already, on the same bank and with the same versions, are kept. A trial
    has a file of its own, AGENT.trial.json. What is interrupted goes on from AGENT.TRACK.jsonl, which holds the records
    of a track until it is whole.

    The work is spread over processes only where that is asked for: the results are the same, but processes side by side
    disturb each other's times.
    """
    from dataclasses import replace

    from greenhouse_gym.agents.named import make_agent
    from greenhouse_gym.evaluation.leaderboard import V1, leaderboard_table, read_entry
    from greenhouse_gym.evaluation.leaderboard import submit as play

    player, rules = make_agent(agent), replace(V1, episodes=episodes)
    with spread(backend, workers, address) as executor:
        path = play(player, agent, out, _parts(track), rules, num_envs, note, executor)
    typer.echo(leaderboard_table([read_entry(path)], rules), nl=False)
    say(f"{'entry' if rules == V1 else 'trial'} in {path}")


def leaderboard(
    folder: Annotated[Path, typer.Argument(help="Folder of the entries.")] = Path("benchmarks/leaderboard"),
    report: Annotated[Path | None, typer.Option(help=_REPORT)] = None,
) -> None:
    """Print the table of all entries of a folder, track by track."""
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.errors import FileFormatError
    from greenhouse_gym.evaluation.leaderboard import leaderboard_table, read_entry

    entries = [read_entry(path) for path in sorted(folder.glob("*.json"))]
    if not entries:
        raise FileFormatError(folder, "holds no entry; `greenhouse-gym submit` writes one")
    typer.echo(leaderboard_table(entries), nl=False)
    if report is not None:
        from greenhouse_gym.reporting.comparison import leaderboard_report

        write_atomically(report, leaderboard_report(entries))
        say(f"report in {report}")


def demonstrations(
    out: Annotated[Path, typer.Option(help="Folder of Minari data sets.")] = Path("demonstrations"),
    agent: Annotated[str, typer.Option(help="Who acts, as `compare` takes it.")] = "guide",
    bank: Bank = "default",
    split: Annotated[str, typer.Option(help="train or validation.")] = "train",
    observation: Annotated[str, typer.Option(help="What is observed, unless the agent says so itself.")] = "state",
    episodes: Annotated[int, typer.Option(min=1, help="How many are played; the successful ones are kept.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed of the first episode.")] = 0,
) -> None:
    """Let an agent act and keep its successful episodes as a Minari data set."""
    from greenhouse_gym.agents.demonstrations import record_demonstrations
    from greenhouse_gym.agents.named import make_agent
    from greenhouse_gym.common.progress import progress

    player = make_agent(agent)
    options = {"bank": bank, "observation": observation, **player.env_options}
    with progress("episodes", episodes) as done:
        name = record_demonstrations(player, out, episodes, seed, split, tell=done, **options)
    say(f"data set {name} in {out}: MINARI_DATASETS_PATH={out} and minari.load_dataset({name!r})")


def watch(
    agent: Annotated[str, typer.Option(help="Who acts, as `compare` takes it.")] = "ppo-waypoint-ur5e",
    out: Annotated[Path, typer.Option(help="MP4 file to write.")] = Path("episode.mp4"),
    bank: Bank = "default",
    split: Annotated[str, typer.Option(help="train, validation or test.")] = "validation",
    seed: Annotated[int, typer.Option(help="Seed of the first episode.")] = 0,
) -> None:
    """Film one episode of an agent."""
    from greenhouse_gym.agents.named import make_agent
    from greenhouse_gym.reporting.film import film

    success = film(make_agent(agent), out, bank=bank, split=split, seed=seed)
    say(f"{'a success' if success else 'no success'}, in {out}")
