"""Train SAC with hindsight experience replay on the goal environment and tell how it gets on.

python training/sac_her.py --bank mini --minutes 16

Prints, every so many steps, the shares of success and collision over episodes of the training and the validation split,
with the processor time spent so far; at last those of random actions. It stops after so many minutes of processor time.
"""

from __future__ import annotations

import argparse

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.evaluation import Evaluation, evaluate
from greenhouse_gym.learning.sac import SacProgress, SacSettings, train_sac


def main() -> None:
    """Train until the time is over, then play at random."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", default=SacSettings.bank)
    parser.add_argument("--difficulty", nargs="+", default=SacSettings.difficulty)
    parser.add_argument("--reward", default=SacSettings.reward)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--minutes", type=float, default=16.0)
    parser.add_argument("--every", type=int, default=20_000)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=SacSettings.seed)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    settings = SacSettings(
        bank=arguments.bank, difficulty=tuple(arguments.difficulty), reward=arguments.reward, seed=arguments.seed,
        threads=arguments.threads,
    )  # fmt: skip
    train_sac(
        settings, arguments.steps, minutes=arguments.minutes, every=arguments.every, episodes=arguments.episodes,
        tell=lambda progress: print(line(progress), flush=True),
    )  # fmt: skip
    result = evaluate(
        RandomAgent(), "train", arguments.episodes, seed=10_000, num_envs=settings.num_envs, bank=settings.bank,
        difficulty=settings.difficulty, threads=settings.threads,
    )  # fmt: skip
    print(f"random actions: {shares('train', result)}")


def line(progress: SacProgress) -> str:
    """One line of the curve."""
    told = f"{progress.steps:,} steps, {progress.updates:,} updates, {progress.seconds:.0f} s of processor time"
    return "; ".join([told, shares("train", progress.train), shares("validation", progress.validation)])


def shares(split: str, result: Evaluation) -> str:
    """How episodes ended."""
    steps = result.median("steps")
    return f"{split}: success {result.success_rate:.0%}, collision {result.collision_rate:.0%}, {steps:.0f} steps"


if __name__ == "__main__":
    main()
