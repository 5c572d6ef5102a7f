"""Train SAC with hindsight experience replay on the goal environment; judge it on validation rows.

python training/sac_her.py --out runs/sac --set bank=mini --set total_steps=200000

Prints, every so many steps, the shares of success and collision over episodes of the training and the validation split,
with the processor time spent so far. Every setting can be given by ``--set``; ``--print`` lists them with what they
mean.
"""

from __future__ import annotations

from training_arguments import parsed

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.evaluation import Evaluation, compare, comparison_table
from greenhouse_gym.learning import SacSettings, load_sac, train_sac
from greenhouse_gym.learning.sac_report import SacProgress
from greenhouse_gym.learning.sb3 import Sb3Agent


def main() -> None:
    """Train, then play validation episodes, at random as well."""
    arguments, settings = parsed(__doc__, SacSettings(), "runs/sac", 100)
    train_sac(settings, arguments.out, resume=arguments.resume, tell=lambda told: print(line(told), flush=True))
    agents = [Sb3Agent(load_sac(arguments.out)), RandomAgent()]
    options = {"bank": settings.bank, "difficulty": settings.difficulty, "robot": settings.robot, "num_envs": 32}
    print(comparison_table(compare(agents, "validation", arguments.episodes, 20_000, **options)))


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
