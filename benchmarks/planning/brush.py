"""Measure what leaves that give way are worth: targets reached, leaves brushed, and the speed of the environment.

python -m benchmarks.planning.brush --episodes 100

Episodes are those of the test rows of the shipped bank with the seeds 0, 1, ..., from the start that targets are rated
from; those of the leaderboard are the targets of a difficulty on its track "brush", all of them. "unreachable" and
"hard" are ratings with rigid leaves. An agent that knows the reconstruction plans in it and
acts in the true row behind it or in the reconstruction itself; one that knows the truth plans in the true row. Plans
have 15,000 collision checks each. The speed is that of a vector environment of 64 arms with random actions, resets
included, on the bank "mini", whose scenes all stay compiled: kinds of plants in turns in one process, compliant ones in
the task of harvesting a fruit. The ratio is taken within each round, in CPU seconds. Each part is stored when it is
finished and not measured again with the same settings. Takes about a CPU second per episode, and some more where the
planner knows the truth.
"""

from __future__ import annotations

import time
from collections import Counter
from statistics import mean, median
from typing import Any

import numpy as np

from benchmarks.common import RESULTS, parser, read_entry, table, write_entry
from greenhouse_gym.agents import PlannerAgent
from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.envs import GreenhouseVectorEnv
from greenhouse_gym.evaluation import Evaluation, evaluate, wilson_interval
from greenhouse_gym.evaluation.leaderboard import read_entry as read_leaderboard
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.truth import true_scene

CHECKS, ENVS, STEPS = 15_000, 64, 40
WORLDS: dict[str, dict[str, dict[str, Any]]] = {
    "reconstruction": {"rigid": {"action": "joint"}, "brush": {"action": "joint"}},
    "truth": {"rigid": {"action": "joint"}, "brush": {"action": "joint"}, "compliant": {"task": "harvest"}},
}
"""Kinds of plants by world, with further options; the first is what the others are held against."""

ENTRIES = RESULTS.parent / "leaderboard"
PARTS: dict[str, dict[str, Any]] = {
    f"{difficulty}, knows the {known}, {physics}, {plants}": {
        "difficulty": difficulty, "known": known, "physics": physics, "plants": plants
    }
    for difficulty, known, physics, plants in (
        ("unreachable", "reconstruction", "truth", "brush"),
        ("hard", "reconstruction", "reconstruction", "brush"),
        ("unreachable", "truth", "truth", "brush"),
        ("unreachable", "reconstruction", "reconstruction", "brush"),
        ("hard", "reconstruction", "truth", "brush"),
        ("hard", "reconstruction", "reconstruction", "rigid"),
        ("unreachable", "reconstruction", "truth", "rigid"),
    )
}  # fmt: skip
PARTS["unreachable of the leaderboard, knows the truth, truth, brush"] = {
    "difficulty": "unreachable", "known": "truth", "physics": "truth", "plants": "brush", "entry": "RRTConnect.json"
}  # fmt: skip


class KnowsTruth(PlannerAgent):
    """A planner that knows the true rows behind the reconstructed scenes of a split."""

    def __init__(self, bank: SceneBank, split: str, **keywords: Any):
        super().__init__(**keywords)
        names = [name for name in bank.names() if bank.split_of(name) == split]
        self._scenes = {_key(bank.scene(name)): name for name in names}
        self._bank = bank

    def reset(self, problem: Problem) -> None:
        """Plan in the true row, to the true tomato nearest to the target."""
        true = true_scene(self._bank.scene(self._scenes[_key(problem.scene)]))
        center = problem.scene.tomatoes[problem.target].center
        nearest = int(np.argmin([np.linalg.norm(tomato.center - center) for tomato in true.tomatoes]))
        known = true.model_copy(update={"name": "scene"})
        super().reset(Problem(**{**vars(problem), "scene": known, "target": nearest}))


def _key(scene: Scene) -> bytes:
    return scene.arrays.starts.tobytes()


def figures_of(evaluation: Evaluation) -> dict[str, Any]:
    """Return the figures of some episodes."""
    records = evaluation.records
    collided = sum(record.collision for record in records)
    leaves = [record.measures.get("brushed_leaves", 0.0) for record in records if record.success]
    seconds = [record.measures.get("brushed_time", 0.0) for record in records if record.success]
    return {
        "episodes": len(records),
        "reached": evaluation.success_rate,
        "reached_95": evaluation.success_interval,
        "collided": evaluation.collision_rate,
        "collided_95": wilson_interval(collided, len(records)),
        "without_a_plan": sum(not record.status.startswith("solved") for record in records) / len(records),
        "status": Counter(record.status for record in records),
        "hit": Counter(record.contact[1].split("_")[0] for record in records if record.collision),
        "median_leaves_of_successes": median(leaves) if leaves else None,
        "mean_seconds_in_leaves_of_successes": mean(seconds) if seconds else None,
        "median_planning_time_s": evaluation.median("planning_time"),
    }


def run_part(part: dict[str, Any], episodes: int, bank: SceneBank) -> dict[str, Any]:
    """Run the episodes of a part and return its figures."""
    keywords: dict[str, Any] = {"max_checks": CHECKS, "attempts": 2}
    agent = PlannerAgent(**keywords) if part["known"] == "reconstruction" else KnowsTruth(bank, "test", **keywords)
    rules: dict[str, Any] = {key: part[key] for key in ("physics", "plants")}
    if "entry" in part:
        records = read_leaderboard(ENTRIES / part["entry"]).evaluation("brush").records
        rules["problems"] = [(r.scene, r.target) for r in records if r.difficulty == part["difficulty"]]
    else:
        rules["difficulty"] = part["difficulty"]
    return figures_of(evaluate(agent, episodes=episodes, bank=bank, split="test", **rules))


def speeds(rounds: int, bank: SceneBank) -> dict[str, Any]:
    """Return CPU seconds per 1,000 steps of the vector environment, by world and plants."""
    result: dict[str, Any] = {"rounds": rounds, "envs": ENVS, "bank": bank.path.name}
    for physics, kinds in WORLDS.items():
        envs = {
            plants: GreenhouseVectorEnv(ENVS, bank=bank, physics=physics, plants=plants, threads=1, **options)
            for plants, options in kinds.items()
        }
        seconds: dict[str, list[float]] = {plants: [] for plants in envs}
        for env in envs.values():
            env.reset(seed=0)
            env.action_space.seed(0)
        for k in range(rounds + 1):  # the first round warms up
            for plants, env in envs.items():
                actions = [env.action_space.sample() for _ in range(STEPS)]
                began = time.process_time()
                for action in actions:
                    env.step(action)
                seconds[plants] += [time.process_time() - began] if k else []
        result[physics] = {
            "cpu_s_per_1000_steps": {
                plants: 1e3 * median(values) / (STEPS * ENVS) for plants, values in seconds.items()
            }
        }
        for plants in list(kinds)[1:]:
            ratios = [rigid / other for rigid, other in zip(seconds["rigid"], seconds[plants], strict=True)]
            result[physics][plants] = {"speed": median(ratios), "ratios": ratios}
    return result


def main() -> None:
    """Measure what is missing, and print everything."""
    options = parser(__doc__)
    options.add_argument("--episodes", type=int, default=100, help="episodes of each part")
    options.add_argument("--rounds", type=int, default=9, help="rounds of the speeds")
    options.add_argument("--part", action="append", choices=[*PARTS, "speed"], help="only these parts")
    arguments = options.parse_args()
    path, bank = RESULTS / "brush.json", SceneBank.open("default")
    chosen = arguments.part or [*PARTS, "speed"]
    rows = []
    for name in (name for name in PARTS if name in chosen):
        settings = {"episodes": arguments.episodes, "bank_sha256": bank.sha256}
        if "entry" in PARTS[name]:
            del settings["episodes"]
        figures = read_entry(path, name, settings)
        if not figures:
            figures = {**run_part(PARTS[name], arguments.episodes, bank), **settings}
            write_entry(path, name, figures)
        rates = (
            f"{figures[key]:.1%} [{figures[f'{key}_95'][0]:.1%}, {figures[f'{key}_95'][1]:.1%}]"
            for key in ("reached", "collided")
        )
        rows.append([name, str(figures["episodes"]), *rates, str(figures["median_leaves_of_successes"])])
        print(rows[-1], figures["status"], figures["hit"], flush=True)
    print(table(["targets, knowledge, world, plants", "episodes", "reached", "collided", "leaves"], rows))
    if "speed" in chosen:
        settings = {"rounds": arguments.rounds, "bank": "mini"}
        figures = read_entry(path, "speed", settings) or speeds(arguments.rounds, SceneBank.open("mini"))
        write_entry(path, "speed", figures)
        for physics, kinds in WORLDS.items():
            for plants in list(kinds)[1:]:
                print(
                    f"{physics}: {plants} plants run at {figures[physics][plants]['speed']:.2f} of the speed of rigid"
                )


if __name__ == "__main__":
    main()
