"""Imitate a teacher that knows the scenes, then continue with PPO, and validate the policy.

python training/bc_then_ppo.py --out runs/bc --set ppo.total_steps=1000000 --set imitation.steps=400000

Every setting can be given by ``--set``, inner ones with a dot; ``--print`` lists and explains them.
"""

from __future__ import annotations

from training_arguments import parsed

from greenhouse_gym.agents import PolicyAgent
from greenhouse_gym.evaluation import compare, comparison_table
from greenhouse_gym.learning import BcThenPpoSettings, train_bc_then_ppo


def main() -> None:
    """Train, then evaluate the policy on validation episodes."""
    arguments, settings = parsed(__doc__, BcThenPpoSettings(), "runs/bc-then-ppo", 512)
    path = train_bc_then_ppo(
        settings, arguments.out, resume=arguments.resume, tell=lambda steps, figures: print(steps, figures, flush=True)
    )
    options = {"bank": settings.ppo.bank, "num_envs": 64}
    print(comparison_table(compare([PolicyAgent.load(path)], "validation", arguments.episodes, 10_000, **options)))


if __name__ == "__main__":
    main()
