"""Imitate a teacher that knows the scenes, continue with PPO, and evaluate the policy on validation rows.

python -m training.bc_then_ppo --out runs/bc --set ppo.total_steps=1000000 --set imitation.steps=400000

``--set`` gives any setting, nested ones with a dot; ``--print`` lists all settings with their descriptions.
"""

from __future__ import annotations

from greenhouse_gym.agents import PolicyAgent
from greenhouse_gym.evaluation import compare, comparison_table
from greenhouse_gym.learning import BcThenPpoSettings, train_bc_then_ppo
from training.arguments import parsed


def main() -> None:
    """Train, then evaluate the policy on validation episodes."""
    arguments, settings = parsed(__doc__, BcThenPpoSettings(), "runs/bc-then-ppo", 512)
    path = train_bc_then_ppo(
        settings,
        arguments.out,
        resume=arguments.resume,
        on_progress=lambda steps, figures: print(steps, figures, flush=True),
    )
    options = {"bank": settings.ppo.bank, "num_envs": 64}
    print(comparison_table(compare([PolicyAgent.load(path)], "validation", arguments.episodes, 10_000, **options)))


if __name__ == "__main__":
    main()
