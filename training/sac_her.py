"""Train SAC with hindsight experience replay on the goal environment and evaluate it on validation rows.

python -m training.sac_her --out runs/sac --set bank=mini --set total_steps=200000

At regular intervals the rates of success and collision over episodes of the training and the validation split are
printed, with the processor time so far. ``--set`` gives any setting; ``--print`` lists all settings with their
descriptions.
"""

from __future__ import annotations

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.evaluation import compare, comparison_table
from greenhouse_gym.learning import SacSettings, load_sac, train_sac
from greenhouse_gym.learning.sb3 import Sb3Agent
from training.arguments import parsed


def main() -> None:
    """Train, then play validation episodes with the policy and with random actions."""
    arguments, settings = parsed(__doc__, SacSettings(), "runs/sac", 100)
    train_sac(settings, arguments.out, resume=arguments.resume)
    agents = [Sb3Agent(load_sac(arguments.out)), RandomAgent()]
    options = {"bank": settings.bank, "difficulty": settings.difficulty, "robot": settings.robot, "num_envs": 32}
    print(comparison_table(compare(agents, "validation", arguments.episodes, 20_000, **options)))


if __name__ == "__main__":
    main()
