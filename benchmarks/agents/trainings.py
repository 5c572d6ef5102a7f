"""Train policies from several seeds and measure how often they reach tomatoes of rows they have not seen.

python -m benchmarks.agents.trainings ppo --seeds 0 1 2 --splits validation test --shielded
python -m benchmarks.agents.trainings imitation --agents roadmap --set imitation.steps=0 --set ppo.total_steps=163840
python -m benchmarks.agents.trainings sac_guided --seeds 0 1 2 --splits test --agents roadmap

Methods: ``ppo`` learns with the settings of ``greenhouse-gym train ppo``; ``imitation`` imitates a teacher before PPO;
``sac`` learns with hindsight replay on the goal environment, and ``sac_guided`` begins with demonstrations by the rule
that follows waypoints. Policies act without exploration noise, and with ``--shielded`` also behind the shield, on the
same episodes for all seeds. ``--agents`` names others that play these episodes. Finished trainings are measured again,
interrupted ones resume. Takes 5 (imitation, guided SAC), 16 (SAC) or 30 minutes (PPO) per seed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.agents.policies import rates
from benchmarks.common import RESULTS, parser, read_entry, write_entry
from greenhouse_gym.agents import PolicyAgent, ShieldedAgent
from greenhouse_gym.agents.agent import Agent
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.common.settings_files import resolve
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.learning import BcThenPpoSettings, PpoSettings, SacSettings, train_bc_then_ppo, train_ppo, train_sac
from greenhouse_gym.learning.training_files import CHECKPOINT, CURVE, VALIDATION, read_curve
from greenhouse_gym.scene import SceneBank

EPISODES = {"validation": (500, 20_000), "test": (1000, 0)}
"""Episodes of a split, and the seed of the first."""

EVERY = 8
"""Every so many lines of a learning curve, one is kept."""


class Method(NamedTuple):
    """A training function and its default settings."""

    train: Callable[..., Any]
    settings: Any


SAC = SacSettings(action="joint", threads=1, total_steps=120_000, validation_steps=20_000, validation_episodes=256)
METHODS = {
    "ppo": Method(train_ppo, PpoSettings(action="joint", validation_steps=500_000, validation_episodes=200)),
    "imitation": Method(train_bc_then_ppo, BcThenPpoSettings()),
    "sac": Method(train_sac, SAC),
    "sac_guided": Method(
        train_sac,
        replace(
            SAC, total_steps=60_000, bank="default", difficulty=("easy", "medium"), observation="goal_roadmap",
            reward="sparse", guided=True, random_steps=30_000,
        ),
    ),
}  # fmt: skip


def main() -> None:
    """Train, play, and write the figures."""
    command = parser(__doc__)
    command.add_argument("method", choices=list(METHODS))
    command.add_argument("--seeds", type=int, nargs="+", default=[0])
    command.add_argument("--splits", nargs="+", choices=list(EPISODES), default=["validation"])
    command.add_argument("--agents", nargs="*", default=["random"], help="others that play the same episodes")
    command.add_argument("--shielded", action="store_true", help="play behind the shield, too")
    command.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="setting of the training")
    command.add_argument("--episodes", type=int, help="of each split, by default 500 (validation) and 1000 (test)")
    command.add_argument("--name", help="of the entry in the file of results; by default the method's")
    command.add_argument("--folder", type=Path, default=Path("runs/trainings"))
    command.add_argument("--out", type=Path, default=RESULTS / "trainings.json")
    a = command.parse_args()
    name = a.name or a.method
    settings = resolve(METHODS[a.method].settings, None, a.set)
    learner = getattr(settings, "ppo", settings)
    bank = SceneBank.open(learner.bank)
    about = {"settings": asdict(settings), "bank_sha256": bank.sha256}
    figures = about | {"policies": {}, "agents": {}} | read_entry(a.out, name, about)

    def measured(agent: Agent, split: str) -> dict[str, Any]:
        episodes, first = EPISODES[split]
        options = {"bank": bank, "difficulty": learner.difficulty, "num_envs": 64, "threads": 1}
        return rates(evaluate(agent, split, a.episodes or episodes, first, **options).records, bank)

    for seed in a.seeds:
        entry = trained(METHODS[a.method], settings, seed, a.folder / f"{name}-{seed}")
        policy = PolicyAgent.load(str(a.folder / f"{name}-{seed}" / "policy.json"))
        for split, agent in product(a.splits, (policy, ShieldedAgent(policy)) if a.shielded else (policy,)):
            entry[f"{'alone' if agent is policy else 'shielded'}, {split}"] = measured(agent, split)
        figures["policies"][f"seed {seed}"] = figures["policies"].get(f"seed {seed}", {}) | entry
        write_entry(a.out, name, figures)
    for other, split in product(a.agents, a.splits):
        figures["agents"][f"{other}, {split}"] = measured(make_agent(other), split)
    write_entry(a.out, name, figures)
    for kind in ("policies", "agents"):
        print(kind, figures[kind])


def trained(method: Method, settings: Any, seed: int, folder: Path) -> dict[str, Any]:
    """Train from a seed into a folder; return the processor time and the learning curves."""
    seeded = replace(settings, ppo=replace(settings.ppo, seed=seed)) if hasattr(settings, "ppo") else None
    began = time.process_time()
    method.train(seeded or replace(settings, seed=seed), folder, resume=(folder / CHECKPOINT).is_file())
    return {
        "processor_minutes": round((time.process_time() - began) / 60, 2),
        "curve": read_curve(folder / CURVE)[EVERY - 1 :: EVERY],
        "validation": read_curve(folder / VALIDATION),
    }


if __name__ == "__main__":
    main()
