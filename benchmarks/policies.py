"""How often agents reach the tomatoes of unseen rows: success and collision with 95 % intervals, by difficulty.

python benchmarks/policies.py --agents ppo-ur5e,waypoint --physics reconstruction,truth --episodes 1000
python benchmarks/policies.py --entries benchmarks/leaderboard

Every agent plays the same episodes: seeds 0, 1, 2, ... of the test split, policies without noise. The world is the
reconstruction, or the simulated row behind it (``truth``). ``shielded`` and ``hybrid`` are made of the best shipped
policy; ``waypoint`` goes without learning where the observation of that name leads. With ``--entries`` nothing is
played: the episodes are those of the leaderboard's entries, on all their tracks, without trials.
Writes results/policies.json, an entry per agent and world; those of other agents that it holds stay.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

from results_file import RESULTS, write_results

from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.agents.policy_agent import BEST
from greenhouse_gym.evaluation import Evaluation, evaluate, wilson_interval
from greenhouse_gym.evaluation.leaderboard import follows, read_entry
from greenhouse_gym.evaluation.records import Record
from greenhouse_gym.scene import DIFFICULTIES, SceneBank

AGENTS = ",".join(dict.fromkeys((BEST, "shielded", "hybrid", "waypoint", "ppo-ur5e", "straight-line", "random")))
"""Who plays."""


def main() -> None:
    """Play and write the figures after each agent."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", default=AGENTS)
    parser.add_argument("--bank", default="default")
    parser.add_argument("--split", default="test")
    parser.add_argument("--physics", default="reconstruction,truth")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--entries", type=Path, help="folder of the leaderboard's entries")
    parser.add_argument("--out", type=Path, default=RESULTS / "policies.json")
    arguments = parser.parse_args()
    figures: dict[str, Any] = json.loads(arguments.out.read_text())["agents"] if arguments.out.is_file() else {}
    for name, world, about, evaluation in _entered(arguments.entries) if arguments.entries else _played(arguments):
        figures[f"{name}, {world}"] = about | rates(evaluation, SceneBank.open(about["bank"]))
        print(name, json.dumps(figures[f"{name}, {world}"]), flush=True)
        write_results(arguments.out, {"agents": figures}, ("mujoco", "numpy"))


_Told = tuple[str, str, dict[str, Any], Evaluation]  # agent, world, which episodes, and what became of them


def _played(arguments: argparse.Namespace) -> Iterator[_Told]:
    for physics, name in product(arguments.physics.split(","), arguments.agents.split(",")):
        evaluation = evaluate(
            make_agent(name), arguments.split, arguments.episodes, arguments.seed, num_envs=arguments.num_envs,
            bank=arguments.bank, physics=physics, threads=1,
        )  # fmt: skip
        about = {"bank": arguments.bank, "bank_sha256": SceneBank.open(arguments.bank).sha256}
        yield name, physics, about | _episodes(arguments.split, physics, arguments.seed), evaluation


def _entered(folder: Path) -> Iterator[_Told]:
    for entry in filter(follows, map(read_entry, sorted(folder.glob("*.json")))):
        for track in entry.tracks:
            about = {"bank": entry.protocol["bank"], "bank_sha256": entry.bank_sha256}
            about |= _episodes(entry.protocol["split"], track, entry.protocol["seed"])
            yield entry.agent, track, about, entry.evaluation(track)


def _episodes(split: str, world: str, first_seed: int) -> dict[str, Any]:
    return {"split": split, "physics": world, "first_seed": first_seed}


def rates(evaluation: Evaluation, bank: SceneBank) -> dict[str, Any]:
    """Shares with their intervals, over all episodes, by difficulty, and by the kind of row."""
    difficulties = {difficulty: evaluation.of(difficulty) for difficulty in DIFFICULTIES}
    return {
        **_shares(evaluation),
        "median_steps_of_successes": evaluation.median("steps", solved_only=True) if evaluation.success_rate else None,
        "by_difficulty": {name: _shares(part) for name, part in difficulties.items() if part.records},
        "by_rows": {rows: _shares(part) for rows, part in _by_rows(evaluation, bank).items()},
    }


def _by_rows(evaluation: Evaluation, bank: SceneBank) -> dict[str, Evaluation]:
    """The episodes on rows of each source, photographed by each protocol."""
    kinds = kinds_of_rows(bank)
    found: dict[str, list[Record]] = {}
    for record in evaluation.records:
        found.setdefault(kinds[record.scene], []).append(record)
    return {rows: Evaluation(evaluation.agent, tuple(found[rows])) for rows in sorted(found)}


def kinds_of_rows(bank: SceneBank) -> dict[str, str]:
    """Source and protocol of each scene's row, by the scene's name."""
    return {entry.name: f"{entry.source or 'own'}, {entry.protocol or 'paper'}" for entry in bank.manifest.scenes}


def _shares(evaluation: Evaluation) -> dict[str, Any]:
    count = len(evaluation.records)
    collisions = sum(record.collision for record in evaluation.records)
    return {
        "episodes": count,
        "success": round(evaluation.success_rate, 4),
        "success_95": [round(bound, 4) for bound in evaluation.success_interval],
        "collision": round(collisions / count, 4),
        "collision_95": [round(bound, 4) for bound in wilson_interval(collisions, count)],
    }


if __name__ == "__main__":
    main()
