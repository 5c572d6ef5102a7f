"""Train a reaching policy with PPO and say how it does on unseen scenes.

python training/ppo.py --bank default --steps 2000000 --out runs/ppo-ur5e
"""

from __future__ import annotations

import argparse
from pathlib import Path

from greenhouse_gym.agents import PolicyAgent, RandomAgent
from greenhouse_gym.evaluation import compare, comparison_table
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
    parser.add_argument("--split", default="validation", help="split to judge the policy on")
    parser.add_argument("--episodes", type=int, default=512)
    arguments = parser.parse_args()
    settings = PpoSettings(bank=arguments.bank, robot=arguments.robot, total_steps=arguments.steps, seed=arguments.seed)
    path = train_ppo(settings, arguments.out, resume=arguments.resume, time_limit=arguments.time_limit)
    agents = (PolicyAgent.load(path), RandomAgent())
    options = {"bank": arguments.bank, "robot": arguments.robot, "num_envs": 64}
    print(comparison_table(compare(agents, arguments.split, arguments.episodes, 10_000, **options)))


if __name__ == "__main__":
    main()
