"""Measure trainings of minutes by Stable-Baselines3 with several actions, rewards, rows and networks.

python -m benchmarks.agents.longer_lessons --seconds 270 --processes 16

Trains by PPO, most with ReLU networks, on easy targets of the training split without three own rows, for a
given time. Then it evaluates on these rows and on the Helios rows of the validation split, in the reconstruction and
with the policy's mean action. Compare times only between machines of equal speed; steps are in the results.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import product
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.agents.cells import left_out_rows
from benchmarks.common import RESULTS, parser, write_results
from greenhouse_gym.envs import DenseReward
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.learning.sb3 import Sb3Agent, make_sb3_vec_env
from greenhouse_gym.learning.sb3_features import ScaledObservation
from greenhouse_gym.scene import SceneBank

NEARER = (0.34, -2.48, 2.58, 0.03, 2.05, 0.0)
"""Start nearer to the plants than `ready`, radians."""


@dataclass(frozen=True)
class Lesson:
    """Settings of a training.

    Attributes:
        name: Its name.
        own: True to train on own rows only.
        action: The action.
        collision: Reward for a collision.
        world: Further keywords of the environment.
        num_envs: Number of simulations.
        backend: Backend of the environment.
        activation: Activation function of the networks, of ``torch.nn``.
        ppo: Keywords of PPO.
        policy: Keywords of its policy.
        scaled: True to scale the features of the observation to about one.
        seed: Seed of episodes, weights and noise.
    """

    name: str
    own: bool = True
    action: str = "joint"
    collision: float = -5.0
    world: dict[str, Any] = field(default_factory=dict)
    num_envs: int = 128
    backend: str = "mujoco"
    activation: str = "ReLU"
    ppo: dict[str, Any] = field(default_factory=dict)
    policy: dict[str, Any] = field(default_factory=dict)
    scaled: bool = False
    seed: int = 0


def lessons() -> list[Lesson]:
    """Return all trainings."""
    big, tip = {"net_arch": [256, 256]}, "tip_velocity"
    quiet, rate = {**big, "log_std_init": -1.0}, {"learning_rate": 5e-4}
    pairs = [
        Lesson(f"{action}, collision {collision:g}, seed {seed}", True, action, collision, seed=seed)
        for seed, action, collision in product((0, 1), ("joint", tip), (-1.0, -5.0))
    ]
    everywhere = [
        Lesson(f"{action}, all rows, seed {seed}", False, action, seed=seed)
        for seed, action in product((0, 1), ("joint", tip))
    ]
    plain: dict[str, Any] = {"num_envs": 256, "backend": "warp", "activation": "Tanh"}
    readme = {"n_steps": 32, "batch_size": 4096, "n_epochs": 5, "learning_rate": 1e-3}
    kernels = [
        Lesson("warp, joint, collision -5", **plain),
        Lesson("warp, tip, collision -5", action=tip, **plain),
        Lesson("warp, ten lines of README", False, tip, **{**plain, "num_envs": 512}, ppo=readme),
    ]
    return [
        *pairs, *everywhere, *kernels, Lesson("joint, collision -5, seed 2", seed=2),
        Lesson("tip, 2x256", action=tip, policy=big),
        Lesson("tip, 2x256, less noise, rate 5e-4", action=tip, policy=quiet, ppo=rate),
        Lesson("tip, scaled", action=tip, scaled=True),
        Lesson("tip, scaled, 2x256, less noise, rate 5e-4", action=tip, policy=quiet, scaled=True, ppo=rate),
        Lesson("tip, the same, all rows", False, tip, policy=quiet, scaled=True, ppo=rate),
        Lesson("joint, scaled, 2x256, less noise, rate 5e-4", policy=quiet, scaled=True, ppo=rate),
        Lesson("joint, the same, all rows", False, policy=quiet, scaled=True, ppo=rate),
        Lesson("tip, discount 0.98", action=tip, ppo={"gamma": 0.98}),
        Lesson("tip, 100 steps", action=tip, world={"step_limit": 100}),
        Lesson("tip, 256 simulations", action=tip, num_envs=256, ppo={"batch_size": 4096, "learning_rate": 6e-4}),
        Lesson("tip, nearer start", action=tip, world={"start": NEARER}),
        Lesson("joint, nearer start", world={"start": NEARER}),
        Lesson("tip, rate 1e-3", action=tip, ppo={"learning_rate": 1e-3}),
        Lesson("tip, less noise", action=tip, policy={"log_std_init": -1.0}),
    ]  # fmt: skip


class TimedCurve(BaseCallback):  # type: ignore[misc]
    """Record steps, seconds and successes after each rollout, and stop after some seconds."""

    def __init__(self, seconds: float):
        super().__init__()
        self.rows: list[list[float]] = []
        self._began, self._seconds = time.monotonic(), seconds

    def _on_step(self) -> bool:
        return time.monotonic() - self._began < self._seconds

    def _on_rollout_end(self) -> None:
        success = float(np.mean(self.model.ep_success_buffer or [0.0]))
        self.rows.append([self.num_timesteps, round(time.monotonic() - self._began, 1), round(success, 3)])


def measured(lesson: Lesson, seconds: float, episodes: int) -> dict[str, Any]:
    """Train, evaluate, and return settings, curve and counts."""
    torch.set_num_threads(1)
    bank = SceneBank.open("default")
    training = bank.select(split="train", source="own" if lesson.own else None)
    left_out = left_out_rows()
    rows = sorted({entry.row for entry in training.manifest.scenes} - set(left_out))
    world = {"action": lesson.action, "reward": DenseReward(collision=lesson.collision), **lesson.world}
    env = make_sb3_vec_env(
        lesson.num_envs, backend=lesson.backend, bank=training.select(row=rows), difficulty="easy", threads=1,
        seed=lesson.seed, **world,
    )  # fmt: skip
    policy = {"activation_fn": getattr(torch.nn, lesson.activation), **lesson.policy}
    if lesson.scaled:
        layout = env.get_attr("simulation")[0].observe.layout
        policy |= {"features_extractor_class": ScaledObservation, "features_extractor_kwargs": {"layout": layout}}
    keywords = {"n_steps": 64, "batch_size": 2048, **lesson.ppo}
    model = PPO("MlpPolicy", env, seed=lesson.seed, device="cpu", policy_kwargs=policy, **keywords)
    curve = TimedCurve(seconds)
    model.learn(10**9, callback=curve)
    evaluated = {}
    for source, difficulty in product(("own", "helios"), ("easy", "medium")):
        where: dict[str, Any] = {"split": "validation", "bank": bank}
        if source == "own":
            where = {"split": "train", "bank": bank.select(row=left_out)}
        records = evaluate(
            Sb3Agent(model), episodes=episodes, seed=10_000, num_envs=100, threads=1, progress=False,
            difficulty=difficulty, **lesson.world, **where,
        ).records  # fmt: skip
        evaluated[f"{source} {difficulty}"] = {
            "episodes": len(records),
            "success": sum(record.success for record in records),
            "collision": sum(record.collision for record in records),
        }
    return asdict(lesson) | {
        "steps": model.num_timesteps, "seconds": round(seconds), "left_out": left_out,
        "curve": [*curve.rows[:-1:10], *curve.rows[-1:]], "evaluated": evaluated,
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all trainings, and write what they reach."""
    command = parser(__doc__)
    command.add_argument("--seconds", type=float, default=270.0, help="time of each training")
    command.add_argument("--episodes", type=int, default=500)
    command.add_argument("--processes", type=int, default=2)
    command.add_argument("--only", nargs="+", help="names of trainings")
    command.add_argument("--out", default=RESULTS / "first_lesson_long.json")
    a = command.parse_args(arguments)
    chosen = [lesson for lesson in lessons() if a.only is None or lesson.name in a.only]
    with ProcessPoolExecutor(a.processes, get_context("spawn")) as pool:
        rows = []
        for row in pool.map(partial(measured, seconds=a.seconds, episodes=a.episodes), chosen):
            rows.append(row)
            print(row["name"], row["steps"], json.dumps(row["evaluated"]), flush=True)
    write_results(a.out, {"trainings": rows})


if __name__ == "__main__":
    main()
