"""Learn which ways are free from depth images, by DAgger; judge the agent that goes by it on validation rows.

python training/depth_dagger.py --out runs/depth --set episodes=200 --set rounds=5

Every setting can be given by ``--set``; ``--print`` lists them with what they mean.
"""

from __future__ import annotations

from training_arguments import parsed

from greenhouse_gym.agents.depth_agent import DepthAgent
from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.evaluation import compare, comparison_table
from greenhouse_gym.learning import DepthSettings, train_depth


def main() -> None:
    """Train, then play validation episodes."""
    arguments, settings = parsed(__doc__, DepthSettings(), "runs/depth", 100)
    path = train_depth(
        settings, arguments.out, resume=arguments.resume, tell=lambda done, figures: print(done, figures, flush=True)
    )
    agent = DepthAgent.of(Policy.load(path), "depth")
    options = {"bank": settings.bank, "difficulty": settings.difficulty, "robot": settings.robot, "threads": 1}
    print(comparison_table(compare([agent], "validation", arguments.episodes, 10_000, **options)))


if __name__ == "__main__":
    main()
