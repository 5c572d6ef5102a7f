"""Memory of long runs: once every scene was met, none is added."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.envs import GreenhouseEnv, GreenhouseVectorEnv, Randomization
from greenhouse_gym.motion import roadmap
from greenhouse_gym.motion.goals import GoalSampler
from greenhouse_gym.motion.roadmap import SceneRoadmaps
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.mjcf import compile_scene

STATM = Path("/proc/self/statm")
PAGE = 4096
MOST = 100 * 2**20 // 100_000
"""Bytes for each step: 100 MB in 100,000 steps."""


def random_steps(env: GreenhouseEnv | GreenhouseVectorEnv) -> Iterator[None]:
    """Yield after each step of all simulations."""
    env.action_space.seed(0)
    env.reset(seed=0)
    while True:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if isinstance(env, GreenhouseEnv) and (terminated or truncated):
            env.reset()
        yield


def run(steps: Iterator[None], count: int) -> int:
    """Run steps and return the bytes in memory afterwards."""
    for _ in range(count):
        next(steps)
    gc.collect()
    return PAGE * int(STATM.read_text().split()[1])


@pytest.mark.skipif(not STATM.exists(), reason="reads Linux's account of memory")
@pytest.mark.parametrize("simulations", [1, 8])
@pytest.mark.parametrize("count", [2000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_memory_is_flat(bank: SceneBank, simulations: int, count: int) -> None:
    options: dict[str, Any] = {
        "bank": bank, "reward": "path", "step_limit": 25, "randomization": Randomization(0.01, 0.01, 0.01, 0.01),
    }  # fmt: skip
    env = GreenhouseEnv(**options) if simulations == 1 else GreenhouseVectorEnv(simulations, **options)
    steps = random_steps(env)
    before = run(steps, 1000 // simulations)
    after = run(steps, count // simulations)
    env.close()
    assert after - before < count * MOST + 2 * 2**20


def test_roadmaps_from_ever_new_starts_make_room(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roadmap, "_CACHE_SIZE", 3)
    arm, rng = get_robot("ur5e"), np.random.default_rng(0)
    roadmaps = SceneRoadmaps(compile_scene(scene))
    for _ in range(5):
        roadmaps.roadmap(GoalSampler(roadmaps.compiled, 0, arm.start + rng.normal(0, 0.01, 6)))
        assert len(roadmaps._nodes) <= 3
        assert len(roadmaps._postures) <= 3
