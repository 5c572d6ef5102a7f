"""Train SAC with hindsight experience replay on the goal environment and validate it.

python training/sac_her.py --out runs/sac --set bank=mini --set total_steps=200000

Prints success and collisions in episodes of the training and the validation split at intervals. Every setting can be
given by ``--set``; ``--print`` lists and explains them.
"""

from __future__ import annotations

from training_arguments import parsed

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.evaluation import compare, comparison_table
from greenhouse_gym.learning import SacSettings, load_sac, train_sac
from greenhouse_gym.learning.sb3 import Sb3Agent


def main() -> None:
    """Train, then compare the model with random actions on validation episodes."""
    arguments, settings = parsed(__doc__, SacSettings(), "runs/sac", 100)
    train_sac(settings, arguments.out, resume=arguments.resume)
    agents = [Sb3Agent(load_sac(arguments.out)), RandomAgent()]
    options = {"bank": settings.bank, "difficulty": settings.difficulty, "robot": settings.robot, "num_envs": 32}
    print(comparison_table(compare(agents, "validation", arguments.episodes, 20_000, **options)))


if __name__ == "__main__":
    main()
