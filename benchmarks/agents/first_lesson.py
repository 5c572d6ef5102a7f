"""Measure the ten lines of README: train, and evaluate on held-out rows; benchmarks/plots.py draws the curve.

python -m benchmarks.agents.first_lesson --seeds 0 1 2
python -m benchmarks.agents.first_lesson --action joint --split train --name "joint actions"

Trains by Stable-Baselines3's PPO on easy targets of the training split, on the Warp kernels. With ``--split train``,
three own rows are left out and played on, and so are the Helios rows of the validation split, so that choices are not
made on test rows. A training takes about four minutes of processor time.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.agents.policies import outcomes
from benchmarks.common import RESULTS, parser, read_entry, write_entry
from greenhouse_gym.agents import ShieldedAgent
from greenhouse_gym.envs import DenseReward
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.learning.policies import save_policy
from greenhouse_gym.learning.sb3 import Sb3Agent, make_sb3_vec_env
from greenhouse_gym.scene import SceneBank

EVALUATED = (("own", "easy"), ("own", "medium"), ("helios", "easy"))
"""Sources and difficulties of the evaluated episodes."""

STEPS = 5_000_000
"""Environment steps of a training."""

RESULT = RESULTS / "first_lesson.json"


def main() -> None:
    """Train, play and write the figures."""
    command = parser(__doc__)
    command.add_argument("--seeds", type=int, nargs="+", default=[0])
    command.add_argument("--steps", type=int, default=STEPS)
    command.add_argument("--sources", nargs="+", default=["own", "helios"], help="of the rows to train on")
    command.add_argument("--action", default="tip_velocity")
    command.add_argument("--start", default="ready")
    command.add_argument("--collision", type=float, default=DenseReward.collision, help="reward for a collision")
    command.add_argument("--falling", action="store_true", help="let the learning rate fall linearly to zero")
    command.add_argument("--step-limit", type=int, default=200)
    command.add_argument("--split", choices=("train", "test"), default="test", help="split of the rows to play on")
    command.add_argument("--episodes", type=int, default=500)
    command.add_argument("--shielded", action="store_true", help="play behind the shield, too")
    command.add_argument("--policies", type=Path, help="folder for the policies, none by default")
    command.add_argument("--name", default="ten lines", help="of the entry in the file of results")
    a = command.parse_args()
    torch.set_num_threads(1)
    default = SceneBank.open("default")
    own = default.select(split="train", source="own")
    left_out = sorted({entry.row for entry in own.manifest.scenes})[::5] if a.split == "train" else []
    bank = default.select(split="train", source=a.sources)
    bank = bank.select(row={entry.row for entry in bank.manifest.scenes} - {*left_out})
    world = {"start": a.start, "step_limit": a.step_limit}
    about = {
        "sources": a.sources, "action": a.action, **world, "collision": a.collision, "split": a.split,
        "left_out": left_out, "bank_sha256": default.sha256,
    }  # fmt: skip
    figures = about | {"seeds": {}} | read_entry(RESULT, a.name, about)
    for seed in a.seeds:
        model, entry = trained(bank, a.steps, seed, a.action, DenseReward(collision=a.collision), world, a.falling)
        if a.policies:
            save_policy(model, a.policies / f"{a.name.replace(' ', '-')}-{seed}")
        policy = Sb3Agent(model)
        for agent in (policy, ShieldedAgent(policy)) if a.shielded else (policy,):
            for source, difficulty in EVALUATED:
                where = {"row": left_out} if left_out and source == "own" else {"source": source}
                split = a.split if source == "own" or a.split == "test" else "validation"
                chosen = default.select(split=split, **where)
                options = {"bank": chosen, "difficulty": difficulty, "num_envs": 64, "threads": 1, **world}
                evaluation = evaluate(agent, split, a.episodes, 20_000, **options)
                kind = f"{'alone' if agent is policy else 'shielded'}, {source}, {difficulty}"
                entry[kind] = outcomes(evaluation.records)
                print(seed, kind, entry[kind], flush=True)
        figures["seeds"][str(seed)] = entry
        write_entry(RESULT, a.name, figures)


class Curve(BaseCallback):  # type: ignore[misc]
    """Record the success of the last 100 training episodes every 100,000 steps."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[list[float]] = []
        self.began = time.process_time()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps < 100_000 * (len(self.lines) + 1):
            return
        success = float(np.mean(self.model.ep_success_buffer or [0.0]))
        self.lines.append([self.num_timesteps, round(time.process_time() - self.began, 1), round(success, 3)])


def trained(
    bank: SceneBank, steps: int, seed: int, action: str, reward: DenseReward, world: dict[str, Any], falling: bool
) -> tuple[PPO, dict[str, Any]]:
    """Train as the ten lines do; return the model and its curve of steps, processor seconds and successes."""
    options = {"difficulty": "easy", "action": action, "reward": reward, **world}
    env = make_sb3_vec_env(512, backend="warp", bank=bank, seed=seed, **options)
    rate: Any = (lambda left: 1e-3 * left) if falling else 1e-3
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=4096, n_epochs=5, learning_rate=rate, seed=seed, device="cpu")
    curve = Curve()
    model.learn(steps, callback=curve)
    return model, {"steps": model.num_timesteps, "curve": curve.lines}


if __name__ == "__main__":
    main()
