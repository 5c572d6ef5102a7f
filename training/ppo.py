"""Train a reaching policy with PPO and say how it does on unseen scenes.

python training/ppo.py --bank default --steps 2000000 --out runs/ppo-ur5e
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.learning.policies import score
from greenhouse_gym.learning.ppo import PpoSettings, train_ppo


def main() -> None:
    """Train, then play unseen episodes with the policy and at random."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/ppo-ur5e"))
    parser.add_argument("--bank", default="default")
    parser.add_argument("--robot", default="ur5e")
    parser.add_argument("--steps", type=int, default=PpoSettings.total_steps)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--time-limit", type=float, default=None, help="seconds")
    parser.add_argument("--split", default="test", help="split to judge the policy on")
    parser.add_argument("--episodes", type=int, default=512)
    arguments = parser.parse_args()
    settings = PpoSettings(bank=arguments.bank, robot=arguments.robot, total_steps=arguments.steps, seed=arguments.seed)
    path = train_ppo(settings, arguments.out, resume=arguments.resume, time_limit=arguments.time_limit)
    options = {"bank": arguments.bank, "split": arguments.split, "robot": arguments.robot}
    policy = Policy.load(path)
    random = np.random.default_rng(arguments.seed)
    agents = {"policy": policy, "random": lambda o: random.uniform(-1, 1, (len(o), len(policy.biases[-1])))}
    for name, act in agents.items():
        result = score(act, arguments.episodes, seed=10_000, **options)
        print(f"{name}: success {result.success:.1%}, collision {result.collision:.1%}, {result.steps:.0f} steps")


if __name__ == "__main__":
    main()
