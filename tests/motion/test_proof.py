"""The same verdicts and numbers of checks as the checker that asks MuJoCo at every configuration."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.motion.collision import MARGIN, PROOF, CollisionChecker, planning_model
from greenhouse_gym.motion.kernel_checker import gaps_in, kernel_world
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
    monkeypatch.setattr(proving, "_free_radius", lambda q, exact: (asked.append(exact), original(q, exact))[1])
    assert proving.motion_is_free(start, start + 0.2, PROOF)
    assert proving.checks > 50
    assert all(asked)
    assert 0 < len(asked) < proving.checks / 3


def test_a_radius_is_a_distance_that_can_be_moved(scene: Scene) -> None:
    compiled = compile_scene(scene)
    model = planning_model(compiled, 0)
    proving, every = ProvingChecker(model), CollisionChecker(model)
    rng = np.random.default_rng(7)
    seen = []
    for _ in range(400):
        q = compiled.robot.start + rng.uniform(-1.5, 1.5, model.nq)
        radius = proving._free_radius(q)
        assert (radius is not None) == every.is_free(q)
        assert proving._free_radius(q, exact=True) == (0.0 if every.is_free(q) else None)
        if radius:
            seen.append(radius)
            way = rng.normal(size=(20, model.nq))
            way *= radius / (np.abs(way) @ proving.reaches)[:, None]
            assert all(map(every.is_free, q + way))
    assert len(seen) > 50
    assert len({round(radius, 6) for radius in seen}) > 20


@pytest.mark.parametrize("robot", ["ur5e", "iiwa14"])
def test_kernels_leave_out_only_what_is_free(shipped: Scene, robot: str) -> None:
    """On motions and around configurations, in any order, and never the nearest one."""
    compiled = compile_scene(shipped, robot)
    model, rng = planning_model(compiled, 0), np.random.default_rng(8)
    every, world = CollisionChecker(model), kernel_world(model)
    assert world is not None
    left_out, far = 0, 0
    for spread in np.repeat([0.0, 0.02, 0.1], 6):
        a, b = (compiled.robot.start + rng.uniform(-1.2, 1.2, (2, model.nq))).clip(
            compiled.robot.lower, compiled.robot.upper
        )
        q = np.linspace(a, b, 80) + rng.normal(0, spread, (80, model.nq))
        distances = gaps_in(world, q, np.inf)
        assert np.isfinite(distances).all()
        certain = gaps_in(world, q, 0.0) == np.inf
        assert all(map(every.is_free, q[certain]))
        left_out += certain.sum()
        smallest = gaps_in(world, q, -1e-9)
        assert smallest.min() == distances.min()
        kept = smallest < np.inf
        np.testing.assert_array_equal(smallest[kept], distances[kept])
        assert (distances[~kept] > distances.min()).all()
        far += (~kept).sum()
    assert left_out > 100
    assert far > 10
