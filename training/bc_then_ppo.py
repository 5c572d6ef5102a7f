"""Imitate a teacher that knows the scenes, then train on with PPO; judge the policy on validation rows.

python training/bc_then_ppo.py --out runs/bc --set ppo.total_steps=1000000 --set imitation.steps=400000

Every setting can be given by ``--set``, inner ones with a point; ``--print`` lists them with what they mean.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from greenhouse_gym.agents import PolicyAgent
from greenhouse_gym.evaluation import compare, comparison_table
from greenhouse_gym.learning import BcThenPpoSettings, train_bc_then_ppo
from greenhouse_gym.settings_files import as_toml, resolve


def main() -> None:
    """Train, then play validation episodes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/bc-then-ppo"))
    parser.add_argument("--settings", type=Path, help="TOML or JSON file of settings")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--print", action="store_true", help="print all settings and do no more")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--episodes", type=int, default=512)
    arguments = parser.parse_args()
    settings = resolve(BcThenPpoSettings(), arguments.settings, arguments.set)
    if arguments.print:
        print(as_toml(settings, comments=True), end="")
        return
    path = train_bc_then_ppo(
        settings, arguments.out, resume=arguments.resume, tell=lambda steps, figures: print(steps, figures, flush=True)
    )
    options = {"bank": settings.ppo.bank, "num_envs": 64}
    print(comparison_table(compare([PolicyAgent.load(path)], "validation", arguments.episodes, 10_000, **options)))


if __name__ == "__main__":
    main()
