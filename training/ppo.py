"""Train a reaching policy with PPO and evaluate it on validation rows.

python -m training.ppo --out runs/ppo-ur5e --set total_steps=2000000 --set robot=ur5e

``--set`` gives any setting; ``--print`` lists all settings with their descriptions.
"""

from __future__ import annotations

from greenhouse_gym.agents import PolicyAgent, RandomAgent
from greenhouse_gym.evaluation import compare, comparison_table
from greenhouse_gym.learning import PpoSettings, train_ppo
from training.arguments import parsed


def main() -> None:
    """Train, then play validation episodes with the policy and with random actions."""
    arguments, settings = parsed(__doc__, PpoSettings(), "runs/ppo-ur5e", 512)
    path = train_ppo(settings, arguments.out, resume=arguments.resume)
    agents = (PolicyAgent.load(path), RandomAgent())
    options = {"bank": settings.bank, "robot": settings.robot, "num_envs": 64}
    print(comparison_table(compare(agents, "validation", arguments.episodes, 10_000, **options)))


if __name__ == "__main__":
    main()
