"""Train SAC with hindsight experience replay on the goal environment and tell how it gets on.

python training/sac_her.py --bank mini --minutes 16

Prints, every so many steps, the shares of success and collision over episodes of the training and the test split, with
the processor time spent so far; at last those of random actions. It stops after so many minutes of processor time.
"""

from __future__ import annotations

import argparse

import numpy as np

from greenhouse_gym.learning.policies import Score, score
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
    model, _ = train_sac(
        settings, arguments.steps, minutes=arguments.minutes, every=arguments.every, episodes=arguments.episodes,
        tell=lambda progress: print(line(progress), flush=True),
    )  # fmt: skip
    random, size = np.random.default_rng(arguments.seed), model.action_space.shape[0]
    options = {"bank": settings.bank, "difficulty": settings.difficulty, "threads": settings.threads}
    result = score(lambda seen: random.uniform(-1, 1, (len(seen), size)), arguments.episodes, seed=10_000, **options)
    print(f"random actions: {shares('train', result)}")


def line(progress: SacProgress) -> str:
    """One line of the curve."""
    told = f"{progress.steps:,} steps, {progress.updates:,} updates, {progress.seconds:.0f} s of processor time"
    return "; ".join([told, shares("train", progress.train), shares("test", progress.test)])


def shares(split: str, result: Score) -> str:
    """How episodes ended."""
    return f"{split}: success {result.success:.0%}, collision {result.collision:.0%}, {result.steps:.0f} steps"


if __name__ == "__main__":
    main()
