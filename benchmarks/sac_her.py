"""How SAC with hindsight replay learns on the goal environment, against random actions.

python benchmarks/sac_her.py
python benchmarks/sac_her.py --guided --minutes 12 --every 10000 --out benchmarks/results/sac_her_guided.json

Trains with the default settings for some minutes of processor time and writes the curve to results/sac_her.json. What
counts are episodes of the validation split, whose rows were not trained on, judged without the policy's noise. With
``--guided`` the bank is ``default``, the targets are easy and medium, the reward is sparse, the waypoint is observed,
and the memory begins with demonstrations by the rule that follows it.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from results_file import RESULTS, write_results

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.evaluation import Evaluation, evaluate
from greenhouse_gym.learning.sac import SacSettings, train_sac
from greenhouse_gym.learning.sac_report import SacProgress

GUIDED: dict[str, Any] = {
    "bank": "default",
    "difficulty": ("easy", "medium"),
    "observation": "goal_waypoint",
    "reward": "sparse",
    "guided": True,
    "random_steps": 30_000,
}
"""Settings with demonstrations, as they were tried."""


def main() -> None:
    """Train, play at random, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=16.0)
    parser.add_argument("--every", type=int, default=20_000)
    parser.add_argument("--episodes", type=int, default=256)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--guided", action="store_true")
    parser.add_argument("--out", type=Path, default=RESULTS / "sac_her.json")
    arguments = parser.parse_args()
    settings = SacSettings(
        seed=arguments.seed, threads=1, total_steps=10_000_000, validation_steps=arguments.every,
        validation_episodes=arguments.episodes, **(GUIDED if arguments.guided else {}),
    )  # fmt: skip
    curve: list[dict[str, Any]] = []
    figures: dict[str, Any] = {"settings": asdict(settings), "random": {}, "curve": curve}

    def note(progress: SacProgress) -> None:
        row = {name: getattr(progress, name) for name in ("steps", "updates", "seconds")}
        curve.append({**row, "train": shares(progress.train), "validation": shares(progress.validation)})
        print(curve[-1], flush=True)
        write_results(arguments.out, figures, ("stable-baselines3", "torch", "mujoco"))

    for split in ("train", "validation"):
        result = evaluate(
            RandomAgent(), split, arguments.episodes, seed=10_000, num_envs=settings.num_envs, bank=settings.bank,
            difficulty=settings.difficulty, threads=1,
        )  # fmt: skip
        figures["random"][split] = shares(result)
    print("random actions", figures["random"], flush=True)
    with tempfile.TemporaryDirectory() as folder:
        train_sac(settings, folder, minutes=arguments.minutes, tell=note)


def shares(result: Evaluation) -> dict[str, float]:
    """The shares of episodes that ended so, and their mean number of steps."""
    steps = sum(record.steps for record in result.records) / len(result.records)
    return {
        "success": round(result.success_rate, 3),
        "collision": round(result.collision_rate, 3),
        "steps": round(steps, 3),
    }


if __name__ == "__main__":
    main()
