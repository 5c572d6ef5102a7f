"""The roadmap behind ``observation="roadmap"`` and the path reward."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.agents import WaypointAgent
from greenhouse_gym.envs import GreenhouseEnv, PathReward, Transition
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.geometry import Capsule
from greenhouse_gym.motion import goals
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.goals import GoalSampler
from greenhouse_gym.motion.roadmap import RESOLUTION, Roadmap, SceneRoadmaps, Waypoint
from greenhouse_gym.motion.waypoints import EVERY, WaypointTracker
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank, Shapes, compile_scene

ARM = get_robot("ur5e")
TARGET = 4
JOINTS = len(ARM.joints)


def roadmap_in(scene: Scene, center: np.ndarray) -> Roadmap:
    compiled = compile_scene(scene, ARM)
    return SceneRoadmaps(compiled).roadmap(GoalSampler(compiled, TARGET, ARM.start, center))


@pytest.fixture(scope="module")
def fenced(scene: Scene) -> Scene:
    """Bars in front of the row, which the arm must make detours around."""
    bars = tuple(Capsule([0.35, y, 0.2], [0.35, y, 2.2], 0.01) for y in np.arange(-0.6, 0.61, 0.25))
    return scene.model_copy(update={"name": "fenced", "clutter": (*scene.clutter, *bars)})


@pytest.mark.parametrize(("kind", "spread", "least"), [("scene", 0.4, 6), ("fenced", 0.05, 6)])
def test_motions_to_free_waypoints_are_free(
    kind: str, spread: float, least: int, request: pytest.FixtureRequest
) -> None:
    scene: Scene = request.getfixturevalue(kind)
    roadmap = roadmap_in(scene, scene.tomatoes[TARGET].center)
    checker = CollisionChecker(planning_model(compile_scene(scene, ARM), TARGET, margin=0.0))
    random = np.random.default_rng(0)
    free = 0
    for _ in range(12):
        joints = ARM.start + random.normal(scale=spread, size=JOINTS)
        waypoint, left, is_free = roadmap.waypoint(joints)
        if is_free:
            free += 1
            assert checker.motion_is_free(joints, waypoint, RESOLUTION)
        assert left >= 0
    assert free >= least
    for node, cost in zip(roadmap.nodes.configurations, roadmap.nodes.costs, strict=True):
        nearer = roadmap.nodes.costs < cost
        gaps = np.linalg.norm(roadmap.nodes.configurations - node, axis=1)
        after = roadmap.nodes.configurations[nearer & np.isclose(gaps + roadmap.nodes.costs, cost)]
        assert cost == 0 or any(checker.motion_is_free(node, end, RESOLUTION) for end in after)


def test_detours_are_found_if_no_goal_is_visible(fenced: Scene) -> None:
    costs = roadmap_in(fenced, fenced.tomatoes[TARGET].center).nodes.costs
    assert (costs > 0).any()
    assert (costs == 0).any()


def test_the_waypoint_of_an_unreachable_target_is_the_start(scene: Scene) -> None:
    roadmap = roadmap_in(scene, np.array([5.0, 0.0, 1.0]))
    waypoint, left, free = roadmap.waypoint(ARM.start)
    np.testing.assert_array_equal(waypoint, ARM.start)
    assert (left, free) == (0.0, False)


def test_going_straight_to_the_waypoint_reaches_most_of_a_thin_row(bank: SceneBank) -> None:
    result = evaluate(WaypointAgent(), "train", 6, bank=bank)
    assert result.success_rate >= 0.8
    assert result.collision_rate == 0.0


def test_it_holds_the_state_without_the_tool_and_says_the_same_of_the_truth(scene: Scene) -> None:
    episode = {"scene": scene.model_copy(update={"truth": Shapes(tomatoes=scene.tomatoes)}), "target": TARGET}
    state, told, of_truth = (
        GreenhouseEnv(bank="mini", observation=kind, physics=physics).reset(options=episode)[0]
        for kind, physics in (("state", "reconstruction"), ("roadmap", "reconstruction"), ("roadmap", "truth"))
    )
    tool = [*range(3 * JOINTS, 3 * JOINTS + 6), *range(3 * JOINTS + 12, 3 * JOINTS + 18)]  # its pose, then its turn
    plain = np.delete(state, tool)
    np.testing.assert_array_equal(told[: len(plain)], plain)
    assert len(told) == len(plain) + 2 * JOINTS + 2
    np.testing.assert_array_equal(told[len(plain) :], of_truth[len(plain) :])
    assert np.abs(told[-JOINTS - 2 : -2]).max() == 1.0, "the direction is an action at full speed"


def test_goals_are_sampled_once_for_each_new_episode(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def counted(*arguments: object) -> object:
        calls.append(arguments)
        return original(*arguments)  # type: ignore[arg-type]

    original = goals.inverse_kinematics
    monkeypatch.setattr(goals, "inverse_kinematics", counted)
    scene = bank.scene(bank.names("train")[0]).model_copy(update={"name": "of this test alone"})
    env = GreenhouseEnv(bank=bank, observation="roadmap")
    for target in (0, 1, 0, 1):
        env.reset(options={"scene": scene, "target": target})
    assert len(calls) == 2


def left(env: GreenhouseEnv) -> float:
    state = env.simulation.state
    assert state is not None
    return float(np.linalg.norm(state.waypoint[0]) + state.path_length[0])


@pytest.mark.parametrize("observation", ["state", "roadmap"])
def test_what_is_paid_for_the_way_depends_on_its_ends_alone(scene: Scene, observation: str) -> None:
    env = GreenhouseEnv(bank="mini", observation=observation, reward="path", step_limit=60)
    for seed in range(3):
        random = np.random.default_rng(seed)
        env.reset(seed=seed, options={"scene": scene, "target": TARGET})
        before, paid, ended = left(env), 0.0, False
        while not ended:
            _, reward, terminated, truncated, info = env.step(random.uniform(-1, 1, JOINTS))
            assert reward == pytest.approx(sum(info["reward_terms"].values()))
            paid += info["reward_terms"]["progress"]
            ended = terminated or truncated
        assert paid == pytest.approx(2.0 * (before - left(env)), abs=1e-9)


def test_going_along_the_way_is_paid_and_staying_is_not(scene: Scene) -> None:
    env = GreenhouseEnv(
        bank="mini", observation="roadmap", action="joint", reward=PathReward(progress=1.0, time=0.0, effort=0.0)
    )
    seen, info = env.reset(options={"scene": scene, "target": TARGET})
    assert env.step(np.zeros(JOINTS))[1] == 0
    total, began = 0.0, left(env)
    for _ in range(100):
        seen, reward, terminated, _, info = env.step(seen[-JOINTS - 2 : -2])
        total += reward
        if terminated:
            break
    assert info["is_success"]
    assert total == pytest.approx(10.0 + began - left(env))


def test_only_who_asks_for_the_way_is_told(scene: Scene) -> None:
    episode = {"scene": scene, "target": TARGET}
    paid, other = (GreenhouseEnv(bank="mini", observation="state", reward=kind) for kind in ("path", "dense"))
    np.testing.assert_array_equal(paid.reset(options=episode)[0], other.reset(options=episode)[0])
    assert paid.simulation.state is not None
    assert other.simulation.state is not None
    assert paid.simulation.state.waypoint.shape == (1, JOINTS)
    assert other.simulation.state.waypoint.shape == (1, 0)


def test_a_reward_of_ones_own_may_ask_for_the_way(scene: Scene) -> None:
    class Straight:
        requires_roadmap = True

        def __call__(self, step: Transition) -> dict[str, np.ndarray]:
            return {"free": step.end.path_free.astype(float)}

    env = GreenhouseEnv(bank="mini", reward=Straight())
    env.reset(options={"scene": scene, "target": TARGET})
    assert env.step(np.zeros(JOINTS))[1] in (0.0, 1.0)


class VisibleFromTheStartOnly(Roadmap):
    """A goal that is visible from the start and from nowhere else."""

    def __init__(self) -> None:
        pass

    def waypoint(self, joints: np.ndarray) -> Waypoint:
        return Waypoint(np.ones(2), 0.0, not joints.any())


def test_a_free_motion_is_not_given_up_halfway() -> None:
    tracker, first = WaypointTracker(1, 2), np.array([0])
    tracker.begin(0, VisibleFromTheStartOnly())
    for command, steps, free in ((0.0, 0, True), (0.5, EVERY, True), (0.5, 0, False)):  # the last begins an episode
        tracker.update(first, np.full((1, 2), command), np.array([steps]))
        assert tracker.free[0] == free
        np.testing.assert_array_equal(tracker.configuration[0], np.ones(2))
