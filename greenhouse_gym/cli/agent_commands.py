"""Commands on agents: compare, submit, leaderboard, demonstrations, watch, policy export."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from greenhouse_gym.cli.options import (
    Address,
    AgentRobot,
    Backend,
    Bank,
    Workers,
    comma_separated,
    executor_of,
    robot_for,
)
from greenhouse_gym.common.progress import progress, say

if TYPE_CHECKING:
    from greenhouse_gym.agents import Agent
    from greenhouse_gym.evaluation import Evaluation

ReportFile = Annotated[
    Path | None, typer.Option("--report", help="HTML file for tables, plots and episodes in 3-D, all in one.")
]

policy_app = typer.Typer(help="Write trained policies for other programs.", no_args_is_help=True)


def compare(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[AGENTS]...",
            help="Planners, policies (names or files), random, straight-line, roadmap, watchful, hybrid, "
            "shielded, or your own as file.py:Class or module:Class.",
        ),
    ] = None,
    agents: Annotated[str, typer.Option(help="Further agents, separated by commas.")] = "",
    bank: Bank = "default",
    split: Annotated[str, typer.Option(help="train, validation or test.")] = "test",
    episodes: Annotated[int, typer.Option(help="Episodes of each agent.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed of the first episode; each further episode adds one.")] = 0,
    robot: AgentRobot = "",
    task: Annotated[str, typer.Option(help="Your own task as file.py:Class or module:Class; reach by default.")] = "",
    difficulty: Annotated[str, typer.Option(help="Difficulties of the targets, separated by commas.")] = "",
    track: Annotated[
        str, typer.Option(help="Worlds of the contacts, separated by commas: reconstruction, truth, moved.")
    ] = "reconstruction",
    num_envs: Annotated[int, typer.Option(help="Episodes to run at once.")] = 1,
    timeout: Annotated[float, typer.Option(help="Timeout of one answer of an agent, seconds.")] = 120.0,
    report: ReportFile = None,
    backend: Backend = None,
    workers: Workers = None,
    address: Address = "local",
) -> None:
    """Run agents on the same episodes and print a table for each track.

    By default these are a planner, the shipped policy and a random agent. Lines below each table state whether the
    agents differ by more than chance, by McNemar's test on the same episodes. An interrupted run prints the table of
    the agents that have finished. The work runs in several processes only on request, because parallel processes
    distort each other's times. For the report, a few episodes are run again at the end.
    """
    from dataclasses import replace

    from greenhouse_gym.agents.named import make_agent
    from greenhouse_gym.agents.policy_agent import BEST
    from greenhouse_gym.errors import require_choice
    from greenhouse_gym.evaluation import compare as run
    from greenhouse_gym.evaluation.leaderboard import TRACKS

    requested = [*(names or ()), *comma_separated(agents)] or ["RRTConnect", BEST, "random"]
    tracks = [require_choice("track", name, TRACKS) for name in comma_separated(track)]
    chosen = _by_name(requested, [make_agent(name) for name in requested])
    shared: dict[str, Any] = {"timeout": timeout}
    own = {"robot": robot, "task": task, "difficulty": comma_separated(difficulty)}
    shared |= {key: value for key, value in own.items() if value}
    if report is not None:
        _require_report(report)
    finished: dict[str, list[Evaluation]] = {}
    complete = False
    try:
        for name in tracks:
            evaluations = finished[name] = []
            try:
                with executor_of(backend, workers, address) as executor:
                    for label, agent in chosen.items():
                        options = {**shared, "bank": bank, "num_envs": num_envs, **TRACKS[name]}
                        (found,) = run([agent], split, episodes, seed, executor=executor, **options)
                        evaluations.append(replace(found, agent=label))
            finally:
                if evaluations:
                    _print_comparison(evaluations, f"track {name}" if len(tracks) > 1 else "")
        complete = True
    finally:
        results = {name: found for name, found in finished.items() if any(e.records for e in found)}
        if report is not None and results:
            from greenhouse_gym.common.files import write_atomically
            from greenhouse_gym.reporting.comparison import comparison_report

            title = f"Comparison of {', '.join(chosen)}"
            # without episodes first: running them again may fail or take long
            for shown in ({}, chosen) if complete else ({},):
                write_atomically(report, comparison_report(title, results, shown, split, bank, **shared))
            say(f"report in {report}")


def _require_report(path: Path) -> None:
    """Raise an error if a report cannot be drawn or written, before the episodes are run for it."""
    import greenhouse_gym.reporting.plots  # noqa: F401  # which needs matplotlib
    from greenhouse_gym.common.files import require_writable

    require_writable(path)


def _print_comparison(evaluations: Sequence[Evaluation], heading: str) -> None:
    from greenhouse_gym.evaluation.records import comparison_notes, comparison_rows, pairings

    if heading:
        say(f"\n{heading}\n")
    comparison_rows(evaluations).show()
    for note in comparison_notes(evaluations):
        say(f"\n{note}")
    for paired in pairings(evaluations):
        say(str(paired))


def _by_name(requested: Sequence[str], agents: Sequence[Agent]) -> dict[str, Agent]:
    """Return agents by their names, or by the requested names if two agents have the same name."""
    alike = len({agent.name for agent in agents}) < len(agents)
    return dict(zip(requested if alike else (agent.name for agent in agents), agents, strict=True))


def submit(
    agent: Annotated[str, typer.Argument(help="An agent, named as in `compare`.")],
    out: Annotated[Path, typer.Option(help="Folder of the entries.")] = Path("benchmarks/leaderboard"),
    track: Annotated[str, typer.Option(help="Tracks, separated by commas.")] = "reconstruction,truth,moved",
    episodes: Annotated[
        int, typer.Option(min=1, help="A number other than the protocol's makes a trial, which is not ranked.")
    ] = 1000,
    num_envs: Annotated[int, typer.Option(help="Episodes to run at once; above 1, times are not comparable.")] = 1,
    note: Annotated[str, typer.Option(help="A remark, such as how the agent was trained.")] = "",
    backend: Backend = None,
    workers: Workers = None,
    address: Address = "local",
) -> None:
    """Run the episodes of protocol v1 and write an entry of the leaderboard (docs/leaderboard.md).

    Tracks of an existing entry of the same agent, bank and versions are kept. A trial has its own file,
    AGENT.trial.json. An interrupted run resumes from AGENT.TRACK.jsonl, which holds the records of a track until all
    its episodes are done.

    The work runs in several processes only on request: the results are the same, but parallel processes distort each
    other's times.
    """
    from dataclasses import replace

    from greenhouse_gym.agents.named import make_agent
    from greenhouse_gym.evaluation.leaderboard import V1, leaderboard_table, read_entry
    from greenhouse_gym.evaluation.leaderboard import submit as run

    player, rules = make_agent(agent), replace(V1, episodes=episodes)
    with executor_of(backend, workers, address) as executor:
        path = run(player, agent, out, comma_separated(track), rules, num_envs, note, executor)
    typer.echo(leaderboard_table([read_entry(path)], rules), nl=False)
    say(f"{'entry' if rules == V1 else 'trial'} in {path}")


def leaderboard(
    folder: Annotated[Path, typer.Argument(help="Folder of the entries.")] = Path("benchmarks/leaderboard"),
    report: ReportFile = None,
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
    agent: Annotated[str, typer.Option(help="The demonstrator, named as in `compare`.")] = "roadmap",
    bank: Bank = "default",
    split: Annotated[str, typer.Option(help="train or validation.")] = "train",
    observation: Annotated[str, typer.Option(help="Observation to record, unless the agent needs another.")] = "state",
    episodes: Annotated[int, typer.Option(min=1, help="Episodes to run; the successful ones are kept.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed of the first episode.")] = 0,
    robot: AgentRobot = "",
) -> None:
    """Run an agent and keep its successful episodes as a Minari data set."""
    from greenhouse_gym.agents.demonstrations import record_demonstrations
    from greenhouse_gym.agents.named import make_agent

    player = make_agent(agent)
    options = {"bank": bank, "observation": observation, **robot_for(player, robot), **player.env_options}
    with progress("episodes", episodes) as on_progress:
        name = record_demonstrations(player, out, episodes, seed, split, on_progress=on_progress, **options)
    say(f"data set {name} in {out}: MINARI_DATASETS_PATH={out} and minari.load_dataset({name!r})")


def watch(
    agent: Annotated[str, typer.Option(help="The agent, named as in `compare`.")] = "ppo-roadmap-ur5e",
    out: Annotated[Path, typer.Option(help="MP4 file to write.")] = Path("episode.mp4"),
    bank: Bank = "default",
    split: Annotated[str, typer.Option(help="train, validation or test.")] = "validation",
    seed: Annotated[int, typer.Option(help="Seed of the episode.")] = 0,
    robot: AgentRobot = "",
) -> None:
    """Film one episode of an agent."""
    from greenhouse_gym.agents.named import make_agent
    from greenhouse_gym.reporting.film import film

    player = make_agent(agent)
    success = film(player, out, seed, bank=bank, split=split, **robot_for(player, robot))
    say(f"{'success' if success else 'no success'}, in {out}")


@policy_app.callback()
def _policy_group() -> None:
    """Keep the group's single command a subcommand."""


@policy_app.command("export")
def export_policy(
    policy: Annotated[str, typer.Argument(help="Name of a shipped policy, or file of a policy.")],
    out: Annotated[Path, typer.Option(help="ONNX file to write.")] = Path("policy.onnx"),
) -> None:
    """Write a policy as one ONNX file: observation in, action out, for runtimes without this package."""
    from greenhouse_gym.agents import PolicyAgent
    from greenhouse_gym.common.extras import require_extras
    from greenhouse_gym.export import onnx_model

    require_extras("onnx")
    agent = PolicyAgent.load(policy)
    onnx_model.export_policy(agent.policy, out, agent.name)
    say(f"{agent.name} in {out}")
