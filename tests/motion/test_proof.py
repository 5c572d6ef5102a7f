"""The same verdicts and numbers of checks as the checker that asks MuJoCo at every configuration."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.motion.collision import MARGIN, PROOF, CollisionChecker, planning_model
from greenhouse_gym.motion.proof import ProvingChecker
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.mjcf import compile_scene


@pytest.fixture(scope="module")
def shipped() -> Scene:
    bank = SceneBank.open("mini")
    return bank.scene(bank.names("train")[0])


@pytest.mark.parametrize("robot", ["ur5e", "iiwa14"])
@pytest.mark.parametrize("margin", [MARGIN, 0.0])
def test_verdicts_and_checks_are_those_of_all_configurations(shipped: Scene, robot: str, margin: float) -> None:
    compiled = compile_scene(shipped, robot)
    lower, upper = compiled.robot.lower, compiled.robot.upper
    model = planning_model(compiled, 0, margin=margin)
    every, proving = CollisionChecker(model), ProvingChecker(model)
    rng = np.random.default_rng(6)
    free, longest = 0, 0
    for _ in range(70):
        a = (compiled.robot.start + rng.uniform(-1.5, 1.5, model.nq)).clip(lower, upper)
        b = (a + rng.choice([0.02, 0.3, 1.5]) * rng.uniform(-1, 1, model.nq)).clip(lower, upper)
        before = every.checks
        verdict = every.motion_is_free(a, b, PROOF)
        assert proving.motion_is_free(a, b, PROOF) == verdict
        assert proving.checks == every.checks
        assert proving.motion_is_free(b, a, PROOF / 3) == every.motion_is_free(b, a, PROOF / 3)
        free += verdict
        longest = max(longest, every.checks - before)
    assert 7 < free < 63
    assert longest > 100


def test_mujoco_is_asked_less_often(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    proving = ProvingChecker(planning_model(compile_scene(scene), 0))
    start = get_robot("ur5e").starts["upright"]
    asked = []
    original = proving._free_radius
    monkeypatch.setattr(proving, "_free_radius", lambda q, gap: (asked.append(1), original(q, gap))[1])
    assert proving.motion_is_free(start, start + 0.2, PROOF)
    assert proving.checks > 50
    assert 0 < len(asked) < proving.checks / 3


@pytest.mark.parametrize("compiled_kernels", [True, False])
def test_a_radius_is_a_distance_that_can_be_moved(scene: Scene, compiled_kernels: bool) -> None:
    compiled = compile_scene(scene)
    model = planning_model(compiled, 0)
    proving, every = ProvingChecker(model), CollisionChecker(model)
    rng = np.random.default_rng(7)
    seen = []
    for _ in range(400):
        q = compiled.robot.start + rng.uniform(-1.5, 1.5, model.nq)
        gaps = proving._gaps(q[None]) if compiled_kernels else None
        radius = proving._free_radius(q, None if gaps is None else gaps[0])
        assert (radius is not None) == every.is_free(q)
        if radius:
            seen.append(radius)
            way = rng.normal(size=(20, model.nq))
            way *= radius / (np.abs(way) @ proving.reaches)[:, None]
            assert all(map(every.is_free, q + way))
    assert len(seen) > 50
    assert len({round(radius, 6) for radius in seen}) > 20
