"""Task "look": what a view finds and carves, and the seam that it uses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import pytest
from reach_helpers import scene_of
from test_vector import compare_with_singles

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.envs import GreenhouseEnv, Outcome, Randomization, State, Task, TomatoLook
from greenhouse_gym.envs.tasks.look import MAP, RIPE
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.geometry import Box, Sphere
from greenhouse_gym.motion.voxel_map import VoxelBox
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.rendering.depth_reading import visible_fractions
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN

LOOK, HOLD = np.eye(7)[6], np.zeros(7)


def env_of(scene: Scene, bank: SceneBank, **keywords: Any) -> GreenhouseEnv:
    made = gymnasium.make("TomatoLook-v0", bank=bank, scene=scene, disable_env_checker=True, **keywords)
    assert isinstance(made.unwrapped, GreenhouseEnv)
    return made.unwrapped


def camera_of(bank: SceneBank) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and axes (3, 3) of the camera at the start, in scenes with the default stand."""
    env = env_of(scene_of([Tomato(Sphere([1.0, 0.0, 0.5], 0.03), 0, 1.0)]), bank)
    env.reset(seed=0)
    simulation = env.simulation
    assert simulation._physics is not None
    (view,) = simulation._perception.take_views(np.array([0]), simulation._physics)
    scene_from_camera = view._scene_from_camera
    return scene_from_camera[:3, 3], scene_from_camera[:3, :3]


def at(bank: SceneBank, x: float, y: float, z: float) -> np.ndarray:
    """A point of the camera's frame in the scene."""
    origin, axes = camera_of(bank)
    return np.asarray(origin + axes @ [x, y, z])


def test_fruit_counts_once_it_is_ripe_near_and_not_hidden(bank: SceneBank) -> None:
    places = {"seen": (0.0, 0.0, 0.7), "green": (0.2, 0.1, 0.7), "hidden": (-0.2, 0.0, 0.7), "far": (0.5, 0.0, 1.3)}
    ripeness = {"green": 0.3}
    fruit = [Tomato(Sphere(at(bank, *p), 0.03), 0, ripeness.get(name, 0.9)) for name, p in places.items()]
    fruit += [Tomato(Sphere(at(bank, 0.1, -0.15, 0.7), 0.03), 0, None)]  # unknown ripeness counts as ripe
    cover = Box(at(bank, -0.15, 0.0, 0.5), np.array([0.06, 0.06, 0.06]), np.eye(3))
    scene = scene_of(fruit).model_copy(update={"clutter": (cover,)})
    env = env_of(scene, bank)
    observation, info = env.reset(seed=0)
    assert (info["ripe"], info["found"], info["views"], info["distance"]) == (4, 0, 0, 1.0)
    assert (observation["map"] == UNKNOWN).all()
    same, reward, _, _, info = env.step(HOLD)
    assert (same["map"] == UNKNOWN).all()
    assert (info["views"], reward) == (0, -0.02)
    observation, reward, terminated, _, info = env.step(LOOK)
    assert (info["found"], info["views"], info["fraction"], info["fraction_1"]) == (2, 1, 0.5, 0.5)
    assert info["reward_terms"] == {"found": 5.0, "view": -0.02, "time": -0.02, "collision": 0.0}
    assert not terminated
    assert not any(name.startswith("_") or name == "map" for name in info)
    vector = observation["state"]
    assert vector[-2:].tolist() == [1, 2]
    unsure = env_of(scene, bank, task=TomatoLook(ripe=0.2, max_range=1.5))
    unsure.reset(seed=0)
    assert unsure.step(LOOK)[4]["found"] == 4


def test_a_view_carves_the_map(bank: SceneBank) -> None:
    fruit, unripe = at(bank, 0.0, 0.0, 0.6), at(bank, 0.2, 0.0, 0.6)
    ripeness = ((fruit, 1.0), (unripe, 0.0), (at(bank, 0.0, 0.3, 3.0), 1.0))
    env = env_of(scene_of([Tomato(Sphere(center, 0.05), 0, ripe) for center, ripe in ripeness]), bank)
    env.reset(seed=0)
    states = env.step(LOOK)[0]["map"].reshape(-1)
    frame = env.simulation._setup(0).world.frame
    assert frame[3] == 1.0

    def state(*point: float) -> int:
        return int(states[MAP.indices((at(bank, *point) - frame[:3])[None])[0]])

    assert state(0.0, 0.0, 0.55) == RIPE
    assert state(0.2, 0.0, 0.56) == OCCUPIED
    assert state(0.0, 0.0, 0.45) == state(0.2, 0.0, 0.4) == state(0.1, 0.0, 0.8) == FREE
    assert state(0.0, 0.0, 0.75) == UNKNOWN, "behind the fruit"
    again = env.step(LOOK)[0]["map"].reshape(-1)
    assert np.array_equal(states, again)


def test_all_found_is_success_and_any_touch_ends(bank: SceneBank) -> None:
    near = Tomato(Sphere(at(bank, 0.0, 0.0, 0.5), 0.04), 0, 1.0)
    env = env_of(scene_of([near]), bank)
    env.reset(seed=0)
    _, reward, terminated, _, info = env.step(LOOK)
    assert terminated
    assert info["is_success"]
    assert reward == pytest.approx(10 - 0.04)
    # the cup may not touch the target that the sampler draws
    tip, axis = np.array(env.simulation.tip(0)), camera_of(bank)[1][:, 2]
    ahead = Tomato(Sphere(tip + 0.06 * axis, 0.03), 0, 1.0)
    env = env_of(scene_of([ahead]), bank, action="tip_velocity")
    env.reset(seed=0)
    towards = np.concatenate([axis, np.zeros(4)])
    for _ in range(20):
        _, _, terminated, _, info = env.step(towards)
        if terminated:
            break
    assert info["collision"]
    assert "tomato_0" in info["contact"]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_vector_equals_single_environments(bank: SceneBank, mode: str) -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (40, 3, 7)) - 0.5 * np.eye(7)[6]
    noisy = Randomization(0.03, 0.05, 0.02, depth_noise=True)
    keywords = {"task": "look", "observation": "task", "randomization": noisy, "step_limit": 15}
    assert compare_with_singles(3, 40, lambda step: actions[step], mode, bank=bank, **keywords) >= 3


def test_agents_know_where_the_arm_stands_alone(bank: SceneBank) -> None:
    problems = []

    class Still:
        name, env_options = "still", {"observation": "task"}

        def reset(self, problem: Any) -> None:
            problems.append(problem)

        def act(self, observation: Any) -> np.ndarray:
            return LOOK

    found = evaluate(Still(), episodes=2, bank=bank, task="look", step_limit=4)  # type: ignore[arg-type]
    assert all(not p.scene.obstacles and p.scene.occupancy is None for p in problems)
    assert problems[0].action_space.shape == (7,)
    measures = found.records[0].measures
    assert measures.keys() == {
        "ripe",
        "found",
        "fraction",
        "views",
        "fraction_1",
        "fraction_3",
        "fraction_5",
        "fraction_10",
    }
    assert measures["views"] <= 4


def test_users_do_not_get_what_only_the_task_knows(bank: SceneBank) -> None:
    names: list[str] = []

    class Curious:
        space = gymnasium.spaces.Box(-1, 1, (1,))

        def __call__(self, state: State) -> np.ndarray:
            names.extend(state.memory)
            return np.zeros((len(state.joints), 1), dtype=np.float32)

    GreenhouseEnv(bank=bank, task="look", observation=Curious()).reset(seed=0)
    assert "map" in names
    assert not any(name.startswith("_") for name in names)


def test_errors_name_the_remedy(bank: SceneBank) -> None:
    green = scene_of([Tomato(Sphere(at(bank, 0.0, 0.0, 0.7), 0.03), 0, 0.2)])
    with pytest.raises(InvalidValueError, match="'placed'; choose another scene"):
        env_of(green, bank).reset(seed=0)
    for wrong in ({"min_visible": 0.0}, {"max_range": 0.05}, {"ripe": np.nan}):
        with pytest.raises(InvalidValueError, match=next(iter(wrong))):
            TomatoLook(**wrong)


class Counting(Task):
    """A task with one control, which remembers how often it was above a half, and an array."""

    controls = ("press",)
    camera = DepthCamera(width=8, height=6)
    memory: Mapping[str, Any] = {"views": 0, "nearest": np.full(3, np.inf)}

    def looks(self, controls: np.ndarray) -> Any:
        return controls[:, 0] > 0.5

    def see(self, view: Any, memory: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"views": memory["views"] + 1, "nearest": np.full(3, view.reading.depth.max())}

    def evaluate(self, state: State) -> Outcome:
        return Outcome(np.zeros(len(state.tip)), state.memory["views"] >= 3, state.collided)


def test_a_users_task_can_have_controls_a_camera_and_arrays(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, task=Counting)
    env.reset(seed=0)
    assert env.action_space.shape == (7,)
    ends = [env.step(np.eye(7)[6] * press)[2:] for press in (1.0, 0.4, 0.6, 1.0)]
    assert [info["views"] for _, _, info in ends] == [1, 1, 2, 3]
    assert [end for end, _, _ in ends] == [False, False, False, True]
    assert env.simulation.state is not None
    assert np.isfinite(env.simulation.state.memory["nearest"]).all()

    class Wrong(Counting):
        def see(self, view: Any, memory: Mapping[str, Any]) -> Mapping[str, Any]:
            return self.answer  # type: ignore[attr-defined, no-any-return]

    for answer, message in (({"view": 1}, "memory must be one of"), ({"nearest": 1.0}, "shape")):
        Wrong.answer = answer  # type: ignore[attr-defined]
        env = GreenhouseEnv(bank=bank, task=Wrong)
        env.reset(seed=0)
        with pytest.raises(InvalidValueError, match=message):
            env.step(LOOK)


def test_half_a_silhouette_behind_an_edge_is_half_visible() -> None:
    spheres, geoms = np.array([[0.1, 0.05, 0.8, 0.05], [0.0, 0.0, 3.0, 0.1], [0.0, 0.0, -0.5, 0.1]]), np.arange(3)
    camera = DepthCamera()
    whole = visible_fractions(camera, spheres, geoms, (0.1, 1.2), lambda rays: np.zeros(len(rays), dtype=np.int64))
    assert whole.tolist() == [1.0, 0.0, 0.0]

    def cut(rays: np.ndarray) -> np.ndarray:
        return np.where(rays[:, 0] / rays[:, 2] < 0.1 / 0.8, 0, 7)

    assert visible_fractions(camera, spheres, geoms, (0.1, 1.2), cut)[0] == pytest.approx(0.5, abs=0.05)
    edge = 0.8 * camera.width / 2 / camera.focal  # the edge of the image cuts a sphere
    on_edge = np.array([[edge - 1e-6, 0.0, 0.8, 0.05]])
    whole = visible_fractions(camera, on_edge, geoms[:1], (0.1, 1.2), lambda rays: np.zeros(len(rays), dtype=np.int64))
    assert whole[0] == pytest.approx(0.5, abs=0.06)


def test_cells_of_a_box_and_those_that_rays_pass() -> None:
    box = VoxelBox((0.0, 0.0, 0.0), (4, 3, 2), 0.1)
    assert np.array_equal(box.indices(box.centers), np.arange(box.size))
    assert box.indices(np.array([[-0.01, 0.1, 0.1], [0.41, 0.1, 0.1], [np.nan, 0.1, 0.1]])).tolist() == [-1, -1, -1]
    passed = box.looked_through(np.array([-0.1, 0.15, 0.05]), np.array([[1.0, 0.0, 0.0]]), np.array([0.35]))
    assert set(np.flatnonzero(passed)) == set(box.indices(np.array([[x, 0.15, 0.05] for x in (0.05, 0.15)])))
