"""Learn which ways are free from depth images, by DAgger; judge the agent that goes by it on validation rows.

python training/depth_dagger.py --out runs/depth --set episodes=200 --set rounds=5

Every setting can be given by ``--set``; ``--print`` lists them with what they mean.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from greenhouse_gym.agents.depth_agent import DepthAgent
from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.evaluation import compare, comparison_table
from greenhouse_gym.learning import DepthSettings, train_depth
from greenhouse_gym.settings_files import as_toml, resolve


def main() -> None:
    """Train, then play validation episodes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/depth"))
    parser.add_argument("--settings", type=Path, help="TOML or JSON file of settings")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--print", action="store_true", help="print all settings and do no more")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--episodes", type=int, default=100)
    arguments = parser.parse_args()
    settings = resolve(DepthSettings(), arguments.settings, arguments.set)
    if arguments.print:
        print(as_toml(settings, comments=True), end="")
        return
    path = train_depth(
        settings, arguments.out, resume=arguments.resume, tell=lambda done, figures: print(done, figures, flush=True)
    )
    agent = DepthAgent.of(Policy.load(path), "depth")
    options = {"bank": settings.bank, "difficulty": settings.difficulty, "robot": settings.robot, "threads": 1}
    print(comparison_table(compare([agent], "validation", arguments.episodes, 10_000, **options)))


if __name__ == "__main__":
    main()
