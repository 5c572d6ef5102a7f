"""Measure how often agents reach tomatoes of rows they have not seen, and how often they collide.

python -m benchmarks.agents.policies --agents ppo-roadmap-ur5e hybrid --physics reconstruction truth --episodes 1000
python -m benchmarks.agents.policies --entries benchmarks/leaderboard
python -m benchmarks.agents.policies --paired before.json benchmarks/leaderboard/watchful.json

All agents play the same episodes: seeds 0, 1, 2, ... of the test split, policies without exploration noise. The arm
touches the reconstruction, or the simulated row behind it ("truth"). With ``--entries`` the episodes are those of the
leaderboard's entries on all their tracks, and nothing is evaluated. ``--paired`` compares two entries of one agent by
McNemar's exact test and writes nothing. Takes 1 to 120 minutes per agent.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from benchmarks.common import RESULTS, parser, rate, write_entry
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.agents.policy_agent import BEST
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation import Evaluation, evaluate
from greenhouse_gym.evaluation.entry import HARVEST
from greenhouse_gym.evaluation.leaderboard import follows, read_entry
from greenhouse_gym.evaluation.records import Record, pairing
from greenhouse_gym.scene import DIFFICULTIES, SceneBank

AGENTS = tuple(dict.fromkeys((BEST, "shielded", "hybrid", "roadmap", "ppo-ur5e", "straight-line", "random")))
"""Agents that play by default."""


def main() -> None:
    """Play and write the figures of each agent."""
    command = parser(__doc__)
    command.add_argument("--agents", nargs="+", default=AGENTS)
    command.add_argument("--bank", default="default")
    command.add_argument("--split", default="test")
    command.add_argument("--physics", nargs="+", default=["reconstruction", "truth"])
    command.add_argument("--start", default="ready", help="start configuration; entries have their own")
    command.add_argument("--episodes", type=int, default=1000)
    command.add_argument("--seed", type=int, default=0, help="of the first episode")
    command.add_argument("--num-envs", type=int, default=64)
    command.add_argument("--entries", type=Path, help="folder of the leaderboard's entries")
    command.add_argument("--paired", type=Path, nargs=2, metavar=("BEFORE", "AFTER"), help="files of two entries")
    command.add_argument("--out", type=Path, default=RESULTS / "policies.json")
    arguments = command.parse_args()
    if arguments.paired:
        compare_entries(*arguments.paired)
        return
    evaluations = of_entries(arguments.entries) if arguments.entries else evaluated(arguments)
    for name, settings, evaluation in evaluations:
        figures = rates(evaluation.records, SceneBank.open(settings["bank"]))
        print(name, figures, flush=True)
        write_entry(arguments.out, name, settings | figures)


_Named = tuple[str, dict[str, Any], Evaluation]  # entry, the episodes that were evaluated, and their records


def evaluated(a: argparse.Namespace) -> Iterator[_Named]:
    """Yield the evaluations of agents in one or both worlds."""
    about = {"bank": a.bank, "bank_sha256": SceneBank.open(a.bank).sha256, "split": a.split, "start": a.start}
    for physics, name in product(a.physics, a.agents):
        world = {"bank": a.bank, "physics": physics, "start": a.start}
        evaluation = evaluate(make_agent(name), a.split, a.episodes, a.seed, num_envs=a.num_envs, threads=1, **world)
        yield f"{name}, {physics}", about | {"physics": physics, "first_seed": a.seed}, evaluation


def of_entries(folder: Path) -> Iterator[_Named]:
    """Yield the evaluations of the leaderboard's entries that follow its rules."""
    for entry in filter(follows, map(read_entry, sorted(folder.glob("*.json")))):
        rules = entry.protocol
        about = {name: rules[name] for name in ("bank", "split", "start")} | {"bank_sha256": entry.bank_sha256}
        for track in (track for track in entry.tracks if track != HARVEST):  # see benchmarks.agents.harvest
            settings = about | {"physics": track, "first_seed": rules["seed"]}
            yield f"{entry.agent}, {track}", settings, entry.evaluation(track)


def compare_entries(first: Path, second: Path) -> None:
    """Print McNemar's exact test of two entries for every track that both have.

    Raises:
        InvalidValueError: The entries were evaluated on different banks.
    """
    before, after = read_entry(first), read_entry(second)
    if before.bank_sha256 != after.bank_sha256:
        raise InvalidValueError(f"{first} and {second} were evaluated on different banks")
    for track in (track for track in before.tracks if track in after.tracks):
        files = ((after, second), (before, first))
        print(f"{track}: {pairing(*(replace(e.evaluation(track), agent=str(file)) for e, file in files))}")


def rates(records: Sequence[Record], bank: SceneBank) -> dict[str, Any]:
    """Return success and collision over all episodes, by difficulty, and by the kind of row."""
    kinds = kinds_of_rows(bank)
    parts = {
        "by_difficulty": grouped(records, [record.difficulty for record in records], DIFFICULTIES),
        "by_rows": grouped(records, [kinds[record.scene] for record in records]),
    }
    steps = Evaluation("", tuple(records)).median("steps", solved_only=True)
    return {
        **outcomes(records),
        "median_steps_of_successes": steps if any(record.success for record in records) else None,
        **{name: {key: outcomes(group) for key, group in part.items()} for name, part in parts.items()},
    }


def grouped(records: Sequence[Record], keys: Sequence[str], order: Sequence[str] = ()) -> dict[str, list[Record]]:
    """Return the records of each key, in the given order or sorted by key."""
    return {
        key: [record for record, own in zip(records, keys, strict=True) if own == key]
        for key in (order or sorted(set(keys)))
        if key in keys
    }


def kinds_of_rows(bank: SceneBank) -> dict[str, str]:
    """Return source and protocol of each scene's row, by the scene's name."""
    return {entry.name: f"{entry.source or 'own'}, {entry.protocol or 'paper'}" for entry in bank.manifest.scenes}


def outcomes(records: Sequence[Record]) -> dict[str, Any]:
    """Return the rates of success and collision with their 95 % intervals."""
    counts = (sum(bool(getattr(record, name)) for record in records) for name in ("success", "collision"))
    return rates_of(len(records), *counts)


def rates_of(episodes: int, success: int, collision: int) -> dict[str, Any]:
    """Return the rates of counted successes and collisions with their 95 % intervals."""
    found: dict[str, Any] = {"episodes": episodes}
    for name, count in (("success", success), ("collision", collision)):
        one = rate(count, episodes)
        found |= {name: one["rate"], f"{name}_95": one["interval"]}
    return found


if __name__ == "__main__":
    main()
