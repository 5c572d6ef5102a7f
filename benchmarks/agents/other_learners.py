"""Measure how far SAC, and PPO with CleanRL's settings, get on the default environment in ten minutes.

python -m benchmarks.agents.other_learners --minutes 10 --seeds 0 1 2

SAC is Stable-Baselines3's with all its defaults. PPO is Stable-Baselines3's with the settings and wrappers of CleanRL's
``ppo_continuous_action``. Both train on one simulation of ``gymnasium.make("TomatoReach-v0")``; afterwards they play
easy targets of test rows.
"""

from __future__ import annotations

import time
from itertools import product
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import greenhouse_gym  # noqa: F401 - registers the environments
from benchmarks.agents.cells import outcomes_in
from benchmarks.common import RESULTS, parser, read_entry, write_entry
from greenhouse_gym.envs import EnvSettings
from greenhouse_gym.learning.sb3 import Sb3Agent

RESULT = RESULTS / "other_learners.json"

LEARNERS = ("SAC", "PPO as in CleanRL")

STEPS = 1_000_000
"""Steps after which CleanRL's learning rate has fallen to zero."""


class Deadline(BaseCallback):  # type: ignore[misc]
    """Stop a training after some seconds of processor time, and record its curve every 10,000 steps."""

    def __init__(self, seconds: float):
        super().__init__()
        self.curve: list[list[float]] = []
        self._end, self._seconds = time.process_time() + seconds, seconds

    def _on_step(self) -> bool:
        left = self._end - time.process_time()
        if self.num_timesteps >= 10_000 * (len(self.curve) + 1):
            success = float(np.mean(self.model.ep_success_buffer or [0.0]))
            self.curve.append([self.num_timesteps, round(self._seconds - left, 1), round(success, 3)])
        return left > 0


def learner(name: str, seed: int, action: str) -> Any:
    """Return an untrained model on one environment."""

    def make() -> gymnasium.Env[Any, Any]:
        return gymnasium.make("TomatoReach-v0", action=action)

    if name == "SAC":
        return SAC("MlpPolicy", make(), seed=seed, device="cpu")
    env = VecNormalize(DummyVecEnv([make]), clip_obs=10.0, clip_reward=10.0, gamma=0.99)
    return PPO(
        "MlpPolicy", env, n_steps=2048, batch_size=64, n_epochs=10, learning_rate=lambda left: 3e-4 * left,
        clip_range_vf=0.2, seed=seed, device="cpu", policy_kwargs={"optimizer_kwargs": {"eps": 1e-5}},
    )  # fmt: skip


def main() -> None:
    """Train, play and write the figures of each training."""
    command = parser(__doc__)
    command.add_argument("--learners", nargs="+", choices=LEARNERS, default=LEARNERS)
    command.add_argument("--minutes", type=float, default=10.0, help="of processor time, for each training")
    command.add_argument("--seeds", type=int, nargs="+", default=[0])
    command.add_argument("--action", default=EnvSettings().action)
    command.add_argument("--episodes", type=int, default=500)
    a = command.parse_args()
    torch.set_num_threads(1)
    for seed, name in product(a.seeds, a.learners):
        model, limit = learner(name, seed, a.action), Deadline(60 * a.minutes)
        model.learn(STEPS, callback=limit)
        entry = {"steps": model.num_timesteps, "curve": limit.curve}
        agent = Sb3Agent(model, name)
        entry |= {cell: outcomes_in(agent, cell, a.episodes) for cell in ("own, easy", "helios, easy")}
        print(name, seed, entry, flush=True)
        about = {"minutes": a.minutes, "action": a.action, "episodes": a.episodes}
        figures = about | {"seeds": {}} | read_entry(RESULT, f"{name}, {a.action}", about)
        figures["seeds"][str(seed)] = entry
        write_entry(RESULT, f"{name}, {a.action}", figures)


if __name__ == "__main__":
    main()
