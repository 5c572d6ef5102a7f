"""Measure the ten lines of README: train, and evaluate on held-out rows; benchmarks/plots.py draws the curve.

python -m benchmarks.agents.first_lesson --seeds 0 1 2
python -m benchmarks.agents.first_lesson --action joint --split train --name "joint actions"
python -m benchmarks.agents.first_lesson --difficulty easy medium hard --falling --name "all targets, falling rate"

Trains by Stable-Baselines3's PPO on the training split, on the Warp kernels. With ``--split train``, three own rows are
left out and played on, and so are the Helios rows of the validation split, so that choices are not made on test rows.
A training takes about four minutes of processor time.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.agents.cells import left_out_rows, outcomes_in
from benchmarks.common import RESULTS, kept_or_temporary, parser, read_entry, write_entry
from greenhouse_gym.agents import PolicyAgent
from greenhouse_gym.envs import DenseReward
from greenhouse_gym.learning.policies import save_policy
from greenhouse_gym.learning.sb3 import make_sb3_vec_env
from greenhouse_gym.scene import SceneBank

EVALUATED = ("own, easy", "own, medium", "helios, easy")
"""Cells of the evaluated episodes."""

STEPS = 5_000_000
"""Environment steps of a training."""

RESULT = RESULTS / "first_lesson.json"


def main() -> None:
    """Train, play and write the figures."""
    command = parser(__doc__)
    command.add_argument("--seeds", type=int, nargs="+", default=[0])
    command.add_argument("--steps", type=int, default=STEPS)
    command.add_argument("--sources", nargs="+", default=["own", "helios"], help="of the rows to train on")
    command.add_argument("--difficulty", nargs="+", default=["easy"], help="of the targets to train on")
    command.add_argument("--action", default="tip_velocity")
    command.add_argument("--falling", action="store_true", help="let the learning rate fall linearly to zero")
    command.add_argument("--start", default="ready")
    command.add_argument("--collision", type=float, default=DenseReward.collision, help="reward for a collision")
    command.add_argument("--step-limit", type=int, default=200)
    command.add_argument("--split", choices=("train", "test"), default="test", help="split of the rows to play on")
    command.add_argument("--episodes", type=int, default=500)
    command.add_argument("--policies", type=Path, help="folder for the policies, none by default")
    command.add_argument("--name", default="ten lines", help="of the entry in the file of results")
    a = command.parse_args()
    torch.set_num_threads(1)
    default = SceneBank.open("default")
    bank = default.select(split="train", source=a.sources)
    left_out = left_out_rows() if a.split == "train" else []
    bank = bank.select(row={entry.row for entry in bank.manifest.scenes} - {*left_out})
    world = {"difficulty": a.difficulty, "action": a.action, "start": a.start, "step_limit": a.step_limit}
    about = {
        "sources": a.sources, **world, "collision": a.collision, "falling": a.falling, "split": a.split,
        "left_out": left_out, "bank_sha256": default.sha256,
    }  # fmt: skip
    for seed in a.seeds:
        model, entry = trained(bank, a.steps, seed, a.falling, reward=DenseReward(collision=a.collision), **world)
        with kept_or_temporary(a.policies) as folder:
            agent = PolicyAgent.load(save_policy(model, folder / f"{a.name.replace(' ', '-')}-{seed}"))
        for cell in EVALUATED:
            split, rows = a.split, tuple(left_out) or None
            if rows and cell.startswith("helios"):
                split, rows = "validation", None
            entry[f"alone, {cell}"] = outcomes_in(agent, cell, a.episodes, split, rows)
            print(seed, cell, entry[f"alone, {cell}"], flush=True)
        figures = about | {"seeds": {}} | read_entry(RESULT, a.name, about)
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


def trained(bank: SceneBank, steps: int, seed: int, falling: bool, **world: Any) -> tuple[PPO, dict[str, Any]]:
    """Train as the ten lines do; return the model and its curve of steps, processor seconds and successes."""
    curve = Curve()
    env = make_sb3_vec_env(512, backend="warp", bank=bank, seed=seed, **world)
    rate: Any = (lambda left: 1e-3 * left) if falling else 1e-3
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=4096, n_epochs=5, learning_rate=rate, seed=seed, device="cpu")
    model.learn(steps, callback=curve)
    seconds = round(time.process_time() - curve.began, 1)
    return model, {"steps": model.num_timesteps, "processor_seconds": seconds, "curve": curve.lines}


if __name__ == "__main__":
    main()
