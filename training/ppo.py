"""Train a reaching policy with PPO and validate it.

python training/ppo.py --out runs/ppo-ur5e --set total_steps=2000000 --set robot=ur5e

Every setting can be given by ``--set``; ``--print`` lists and explains them.
"""

from __future__ import annotations

from training_arguments import parsed

from greenhouse_gym.agents import PolicyAgent, RandomAgent
from greenhouse_gym.evaluation import compare, comparison_table
from greenhouse_gym.learning import PpoSettings, train_ppo


def main() -> None:
    """Train, then compare the policy with random actions on validation episodes."""
    arguments, settings = parsed(__doc__, PpoSettings(), "runs/ppo-ur5e", 512)
    path = train_ppo(settings, arguments.out, resume=arguments.resume)
    agents = (PolicyAgent.load(path), RandomAgent())
    options = {"bank": settings.bank, "robot": settings.robot, "num_envs": 64}
    print(comparison_table(compare(agents, "validation", arguments.episodes, 10_000, **options)))


if __name__ == "__main__":
    main()
