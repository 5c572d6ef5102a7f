"""NumPy's numbers are as good as Python's wherever a seed, a count, an index or a limit is given."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.capture import simulate_recording
from greenhouse_gym.crops import grow_row
from greenhouse_gym.envs import DenseReward, GreenhouseEnv, GreenhouseVectorEnv
from greenhouse_gym.errors import InvalidValueError, require_seed
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.planning import plan
from greenhouse_gym.scene import Scene, SceneBank, compile_scene

KINDS = (np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint32, np.uint64)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return SceneBank.open("mini")[0]


@pytest.mark.parametrize("planner", ["RRTConnect", "RRT"])
def test_plans_of_numpy_seeds_are_those_of_pythons(scene: Scene, planner: str) -> None:
    target = scene.targets[0].tomato
    usual = plan(scene, target, planner=planner, seed=1, time_limit=None, max_checks=3000, goals=10)
    for kind in (np.int32, np.uint8, np.int64):
        limits = {"time_limit": None, "max_checks": np.int64(3000)}
        found = plan(scene, kind(target), planner=planner, seed=kind(1), goals=kind(10), **limits)
        assert found.status == usual.status
        np.testing.assert_array_equal(np.asarray(found.path), np.asarray(usual.path))


def test_settings_of_planners(scene: Scene) -> None:
    target = scene.targets[0].tomato
    found = plan(scene, target, time_limit=np.float32(60), max_checks=3000, settings={"range": np.float32(0.5)})
    assert found.status == "solved"


def test_environments(scene: Scene) -> None:
    env = GreenhouseEnv(bank="mini", step_limit=np.int64(50), success_radius=np.float32(0.02))
    usual, _ = env.reset(seed=3)
    for kind in KINDS:
        options = {"scene": scene.name, "target": kind(scene.targets[0].tomato)}
        np.testing.assert_array_equal(env.reset(seed=kind(3))[0], usual)
        env.reset(seed=kind(3), options=options)
    vector = GreenhouseVectorEnv(np.int64(2), bank="mini")
    first, _ = vector.reset(seed=[1, 2])
    np.testing.assert_array_equal(vector.reset(seed=[np.int32(1), np.uint8(2)])[0], first)
    np.testing.assert_array_equal(vector.reset(seed=np.array([1, 2]))[0], first)
    np.testing.assert_array_equal(vector.reset(seed=np.int16(1))[0], first)


def test_evaluations_and_their_files(scene: Scene) -> None:
    usual = evaluate(RandomAgent(), bank="mini", episodes=2, seed=100, progress=False)
    found = evaluate(RandomAgent(), bank="mini", episodes=np.int8(2), seed=np.int8(100), progress=False)
    assert [record.steps for record in found.records] == [record.steps for record in usual.records]
    assert json.dumps([record.seed for record in found.records]) == "[100, 101]"


def test_rows_recordings_and_models(scene: Scene) -> None:
    """A seed of 32 bits does not overflow."""
    row = grow_row(np.int32(2**31 - 1), np.float32(0.5), np.int8(1))
    assert len(row.tomatoes) == len(grow_row(2**31 - 1, 0.5, 1).tomatoes)
    recording = simulate_recording(row, np.int32(7), stations=np.int8(2))
    assert (len(recording), recording.name) == (2, "simulated-7")
    assert compile_scene(scene, capacity=np.int16(400)).model.ngeom > 400
    assert DenseReward(success=np.float32(1)).success == 1
    assert SceneBank.open("mini")[np.int64(0)].name == scene.name


@pytest.mark.parametrize("bad", [np.int64(-1), np.float64(1.0), np.bool_(True), "1", None, 1.5, True])
@pytest.mark.parametrize(
    "use", [require_seed, lambda seed: grow_row(seed, 0.5), lambda seed: evaluate("random", seed=seed)]
)
def test_what_is_no_seed_is_refused(use: Callable[[Any], object], bad: Any) -> None:
    with pytest.raises(InvalidValueError, match="seed must be a whole number from 0 on"):
        use(bad)
