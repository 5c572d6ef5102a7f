"""The agent that knows the scan and observes unknown space, and its maps and viewpoints."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from occupancy_helpers import known_where, with_surface_at

from greenhouse_gym.agents import Problem, watchful, watchful_paths
from greenhouse_gym.agents.agent import Agent
from greenhouse_gym.agents.local_map import CLEARANCE, LocalMap
from greenhouse_gym.agents.occupancy_map import wrist_camera
from greenhouse_gym.agents.planner_agent import PathFollower
from greenhouse_gym.agents.viewpoints import DEPTHS, MIN_GAIN, OpaqueCells, initial_view, viewpoints, visible
from greenhouse_gym.agents.watchful import CAUTION_DEPTHS, WatchfulAgent, caution_levels
from greenhouse_gym.agents.watchful_paths import PlannedPaths
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.geometry import Box, distance_to_shapes, pose, rotation_about, transform
from greenhouse_gym.geometry.voxels import cells_of
from greenhouse_gym.motion.arm_spheres import ArmSpheres, arm_spheres
from greenhouse_gym.motion.caution import CautionLevel, unexplained_cells, with_margin
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.goals import GoalSampler
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.roadmap import Roadmap, SceneRoadmaps
from greenhouse_gym.planning import PlanResult
from greenhouse_gym.rendering.cameras import MAX_RANGE, CameraRig, DepthCamera
from greenhouse_gym.robots import get_robot
from greenhouse_gym.robots.kinematics import tool_state
from greenhouse_gym.scene import Scene, compile_scene
from greenhouse_gym.scene.mjcf import base_position
from greenhouse_gym.scene.occupancy import FREE, UNKNOWN

ARM = get_robot("ur5e")
START = ARM.starts["upright"]
TARGET = 4
LEVELS = caution_levels(0.0, unexplained=False, depth=0.1)
CAMERA = DepthCamera()


class Follower:
    """Follow the roadmap of the scan without looking."""

    name, env_options = "follower", {"action": "joint"}

    def reset(self, problem: Problem) -> None:
        compiled = compile_scene(problem.scene, problem.robot)
        roadmap = SceneRoadmaps(compiled).roadmap(GoalSampler(compiled, problem.target, problem.start))
        self._follower = PathFollower(np.array([problem.start, *roadmap.path(problem.start)]), problem)

    def act(self, observation: object) -> np.ndarray:
        return self._follower.action()


@pytest.fixture(scope="module")
def arm() -> ArmSpheres:
    return arm_spheres(ARM)


@pytest.fixture(scope="module")
def hung(scene: Scene) -> Scene:
    """The scene with a leaf where the tip goes that follows the scan, which knows nothing of it."""
    tips = played(Follower(), scene, scene)[1]
    leaf = Box(tips[3 * len(tips) // 4], [0.02, 0.02, 0.02], np.eye(3))
    return scene.model_copy(update={"clutter": (*scene.clutter, leaf)})


def played(agent: Agent, told: Scene, true: Scene) -> tuple[str, np.ndarray]:
    """Run an agent that knows one scene in another; return the outcome and the positions (steps, 3) of its tip."""
    env = GreenhouseEnv(bank="mini", start="upright", **agent.env_options)
    observation, info = env.reset(options={"scene": true, "target": TARGET})
    agent.reset(Problem(told, TARGET, ARM, env.start))
    chain, base, tips = arm_spheres(ARM).chain, base_position(told, ARM), []
    over = False
    while not over:
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        over = terminated or truncated
        tips.append(tool_state(chain, env.model_and_data()[1].qpos[None]).point[0] + base)
    env.close()
    return "reached" if info["is_success"] else "collided" if info["collision"] else "late", np.array(tips)


def test_it_goes_around_what_the_scan_does_not_show(scene: Scene, hung: Scene) -> None:
    assert played(Follower(), scene, hung)[0] == "collided", "the leaf is in the way"
    assert played(WatchfulAgent(), scene, hung)[0] == "reached"


def test_it_looks_at_what_nobody_has_seen_before_it_goes_there(scene: Scene) -> None:
    seen, dark = WatchfulAgent(), WatchfulAgent()
    assert played(seen, known_where(scene, None), scene)[0] == "reached"
    assert played(dark, known_where(scene, 1.2, aisle=0.3), scene)[0] == "reached"
    assert seen.status == "1, 0.05"
    assert int(dark.status.split(",")[0]) > 1, "it looked for a way anew once it had looked"
    bold = WatchfulAgent(depth=0.1)
    assert played(bold, known_where(scene, None), scene)[0] == "reached"
    assert bold.status == "1, 0.1"


def test_its_images_may_be_of_another_size(scene: Scene, hung: Scene) -> None:
    agent = WatchfulAgent(image=(96, 72))
    env = GreenhouseEnv(bank="mini", start="upright", **agent.env_options)
    assert env.observation_space["depth"].shape == (1, 72, 96)  # type: ignore[index]
    env.close()
    assert played(agent, scene, hung)[0] == "reached"
    assert WatchfulAgent().env_options != agent.env_options, "those of others stay as they were"


@pytest.mark.parametrize("margin", [-0.01, float("nan"), float("inf")])
def test_a_margin_without_a_meaning_is_refused(margin: float) -> None:
    with pytest.raises(InvalidValueError, match="margin"):
        WatchfulAgent(margin)


def test_a_depth_or_an_image_without_a_meaning_is_refused() -> None:
    for depth in (-0.05, float("nan")):
        with pytest.raises(InvalidValueError, match=f"depth must be 0 m or more, got {depth}"):
            WatchfulAgent(depth=depth)
    with pytest.raises(InvalidValueError, match="a camera's width must be a whole number from 1"):
        WatchfulAgent(image=(0, 48))
    with pytest.raises(InvalidValueError, match=r"a width and a height, pixels, got \(64,\)"):
        WatchfulAgent(image=(64,))  # type: ignore[arg-type]


def test_a_margin_comes_before_depth_and_goes_at_last() -> None:
    levels, defaults = (
        caution_levels(0.02, unexplained=False, depth=0.1),
        caution_levels(0.0, unexplained=False, depth=0.1),
    )
    assert levels == [
        CautionLevel(0.02, 0.1),
        CautionLevel(0.02, 0.2),
        CautionLevel(0.01, 0.2),
        CautionLevel(0.0, 0.2),
        CautionLevel(0.0, np.inf),
    ]
    assert defaults == [CautionLevel(0.0, depth) for depth in CAUTION_DEPTHS]


@pytest.mark.parametrize("margin", [0.0, 0.02])
def test_surfaces_without_a_shape_are_left_out_of_account_at_last(margin: float) -> None:
    levels = caution_levels(margin, unexplained=True, depth=0.05)
    heeding = [level for level in levels if level.unexplained]
    assert levels[: len(heeding)] == heeding
    assert heeding[:2] == [CautionLevel(margin, 0.05, unexplained=True), CautionLevel(margin, 0.1, unexplained=True)]
    assert heeding[-1] == CautionLevel(0.0, np.inf, unexplained=True)
    assert levels[-2:] == [CautionLevel(0.0, 0.2), CautionLevel(0.0, np.inf)]


def planned_way(scene: Scene, margin: float) -> list[np.ndarray]:
    """The configurations (j,) of the way that the agent finds at first."""
    levels = caution_levels(margin, unexplained=False, depth=0.1)
    found = PlannedPaths(Problem(scene, TARGET, ARM, START), levels, False).find(lambda voxel: scene, START, [])
    assert found.level == CautionLevel(margin, np.inf), "the scene does not say what was seen of it"
    return [START, *found.path]


def episode_of(scene: Scene, target: np.ndarray, seed: int = 0) -> watchful._Episode:
    problem = Problem(scene, TARGET, ARM, START, seed)
    return watchful._Episode(problem, target, CAMERA, LEVELS, PlannedPaths(problem, LEVELS, False), False)


def keeps(way: list[np.ndarray], scene: Scene, margin: float) -> bool:
    """Return whether a path keeps a margin from the boxes of a scene, metres."""
    around = compile_scene(with_margin(scene, ARM, START, margin), ARM)
    checker = CollisionChecker(planning_model(around, TARGET, margin=0.0), arm_reaches(ARM))
    return all(checker.motion_is_free(*ends, 0.005) for ends in itertools.pairwise(way))


def test_with_a_margin_its_way_keeps_from_what_the_scan_shows(scene: Scene) -> None:
    way = planned_way(scene, 0.0)
    tip = tool_state(arm_spheres(ARM).chain, (way[0] + way[1])[None] / 2).point[0] + base_position(scene, ARM)
    leaves = [Box(tip + [0.0, 0.0, up], [0.02, 0.02, 0.005], np.eye(3)) for up in np.arange(0.0, 0.3, 0.01)]
    leafy = [scene.model_copy(update={"clutter": (*scene.clutter, leaf)}) for leaf in leaves]
    beside = next(each for each in leafy if keeps(way, each, 0.005))
    assert not keeps(way, beside, 0.02), "the leaf hangs close to the way"
    assert keeps(planned_way(beside, 0.02), beside, 0.02)


def test_where_nothing_else_leads_on_it_goes_back_as_it_came(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """No straight motions lead to the target, and RRTConnect finds a path from the start alone."""
    asked: list[np.ndarray] = []
    goal = START + [0.5, -0.2, 0.3, 0.0, 0.0, 0.0]

    def planned(*arguments: Any, start: np.ndarray, goals: np.ndarray, **keywords: Any) -> PlanResult:
        asked.append(start)
        found = np.array_equal(start, START)
        path = np.array([start, goal]) if found else None
        return PlanResult("solved" if found else "approximate", path, "RRTConnect")

    monkeypatch.setattr(Roadmap, "path", lambda roadmap, joints: [])
    monkeypatch.setattr(watchful_paths, "plan", planned)
    monkeypatch.setattr(watchful, "MAX_LOOKS", 0)
    env = GreenhouseEnv(bank="mini", start="upright", **WatchfulAgent().env_options)
    observation, _ = env.reset(options={"scene": scene, "target": TARGET})
    agent = WatchfulAgent()
    agent.reset(Problem(scene, TARGET, ARM, env.start))
    been = [env.start]
    while not been[1:] or np.abs(been[-1] - goal).max() > 0.02:
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        been.append(env.model_and_data()[1].qpos.copy())
        over = terminated or truncated
        assert not over, info
    env.close()
    here, back = asked
    assert np.array_equal(back, START)
    assert not np.array_equal(here, START)
    ends = [np.abs(np.array(been) - place).max(axis=1).argmin() for place in (here, goal)]
    between = np.abs(np.array(been[ends[0] : ends[1]]) - START).max(axis=1)
    assert between.min() < 0.05, "it came by the start again"
    assert agent.status == "1, inf"


def test_where_it_would_stay_it_asks_again_but_not_for_ever(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other goals and another seed each time; unknown space is closed at first, free at last."""
    told, asked = known_where(scene, 0.0), []
    goal = START + [0.3, -0.2, 0.3, 0.0, 0.0, 0.0]

    def planned(*arguments: Any, start: np.ndarray, **keywords: Any) -> PlanResult:
        asked.append(keywords)
        found = isinstance(keywords["goals"], int) and keywords["unknown"] == "free" and finds
        return PlanResult(
            "solved" if found else "approximate", np.array([start, goal]) if found else None, "RRTConnect"
        )

    monkeypatch.setattr(Roadmap, "path", lambda roadmap, joints: [])
    monkeypatch.setattr(watchful_paths, "plan", planned)
    monkeypatch.setattr(watchful, "MAX_LOOKS", 0)
    image = np.zeros((48, 64), dtype=np.float32)
    for finds in (True, False):
        asked.clear()
        episode = episode_of(told, scene.tomatoes[TARGET].center, seed=40)
        episode._path = []
        acted = [episode.act(image, START, START) for _ in range(watchful.MAX_PLANS + watchful.EXTRA_PLANS + 3)]
        first, again = asked[:2], asked[2:]
        assert [each["seed"] for each in first] == [40, 40], "from where it is, and from the start"
        careful = watchful.MAX_PLANS - watchful.FREE_PLANS - 1
        seeds = np.repeat(41 + np.arange(1, watchful.MAX_PLANS + watchful.EXTRA_PLANS), 2)[: len(again)]
        assert [each["seed"] for each in again] == seeds.tolist()
        assert [each["unknown"] for each in again[: 2 * careful]] == [0.2] * (2 * careful)
        if finds:
            assert len(again) == 2 * careful + 1
            assert np.abs(acted[-1]).max() > 0, "it goes"
            assert episode.status == f"{careful + 2}, inf"
        else:
            assert len(again) == 2 * (watchful.MAX_PLANS + watchful.EXTRA_PLANS - 1)
            more = [0.2] * watchful.EXTRA_PLANS + ["free"] * watchful.EXTRA_PLANS
            assert [each["unknown"] for each in again[-len(more) :]] == more
            assert not np.abs(acted).any(), "it stays"
            assert episode.status == f"{watchful.MAX_PLANS + watchful.EXTRA_PLANS}, no path"


def test_a_box_of_the_scan_in_which_it_sees_nothing_is_no_obstacle_in_the_end(scene: Scene) -> None:
    """The scan has a box about the whole target, of which nothing is there in truth."""
    box = Box(scene.tomatoes[TARGET].center - [0.02, 0.0, 0.0], [0.07, 0.07, 0.07], np.eye(3))
    told = known_where(scene.model_copy(update={"clutter": (*scene.clutter, box)}), None)
    agent = WatchfulAgent()
    assert played(agent, told, scene)[0] == "reached"
    assert int(agent.status.split(",")[0]) > watchful.MAX_PLANS


def test_the_camera_stands_for_boxes_that_it_has_looked_at_and_for_no_others(scene: Scene) -> None:
    env = GreenhouseEnv(bank="mini", start="upright", observation="depth")
    base = base_position(scene, ARM)
    target = scene.tomatoes[TARGET].center - base
    aims = first_viewpoint(target)
    leaf = Box(scene.tomatoes[TARGET].center + [-0.1, 0.0, 0.0], [0.002, 0.03, 0.03], np.eye(3))
    about = Box(leaf.center, [0.04, 0.05, 0.05], np.eye(3))
    away = Box(base + [-0.5, 0.0, 0.5], [0.05, 0.05, 0.05], np.eye(3))
    true = scene.model_copy(update={"clutter": (*scene.clutter, leaf)})
    told = scene.model_copy(update={"clutter": (about, away)})
    observation, _ = env.reset(options={"scene": true, "target": TARGET, "start": aims})
    known = LocalMap(Problem(told, TARGET, ARM, env.start), target, CAMERA)
    known.add(observation["depth"][0] * MAX_RANGE, aims)
    on_leaf = distance_to_shapes(known.points_at_boxes + base, [leaf])[:, 0] < 1e-3
    assert on_leaf.any()
    assert not (distance_to_shapes(known.points + base, [leaf]) < 1e-3).any(), "the scan's box stands for it"
    trusting, wary = (known.scene(aims, 0.004, boxes).clutter for boxes in (True, False))
    np.testing.assert_array_equal([box.center for box in trusting[:2]], [about.center, away.center])
    np.testing.assert_array_equal(wary[0].center, away.center)
    assert (distance_to_shapes(leaf.center[None], wary[1:]) < 0.005).any(), "the leaf does"


def test_what_it_went_back_on_is_forgotten(scene: Scene) -> None:
    episode = episode_of(scene, scene.tomatoes[TARGET].center)
    start, there, farther = START, START + 0.1, START + 0.2
    episode._trail = [start]
    for place in (there, farther, there, start, farther):
        episode._arrive(place)
    assert [each is place for each, place in zip(episode._trail, (start, farther), strict=True)] == [True, True]


def test_it_must_be_reset_before_it_acts() -> None:
    with pytest.raises(RuntimeError, match="reset"):
        WatchfulAgent().act(None)


def test_what_is_known_grows_with_the_images(scene: Scene, arm: ArmSpheres) -> None:
    env = GreenhouseEnv(bank="mini", start="upright", observation="depth")
    base = base_position(scene, ARM)
    target = scene.tomatoes[TARGET].center - base
    leaf = np.array([0.57, -0.07, 0.61])  # in front of the camera and of space that it has not seen
    hung = scene.model_copy(update={"clutter": (*scene.clutter, Box(leaf + base, [0.02, 0.02, 0.02], np.eye(3)))})
    aims = first_viewpoint(leaf)
    told = known_where(scene, 0.0)
    observation, _ = env.reset(options={"scene": hung, "target": TARGET, "start": aims})
    known = LocalMap(Problem(told, TARGET, ARM, env.start), target, CAMERA)
    way = np.array([aims, aims + [0.0, 0.3, 0.0, 0.0, 0.0, 0.0]])
    dark = known.unobserved(way)
    assert not known.blocked(way)
    assert len(known.scene(aims, 0.01).clutter) == len(scene.clutter)

    assert known.add(observation["depth"][0] * MAX_RANGE, aims)
    assert not known.add(observation["depth"][0] * MAX_RANGE, aims), "the same image shows nothing new"
    assert (distance_to_shapes(known.points + base, hung.clutter[-1:]) < 1e-3).any(), "it has seen the leaf"
    assert (distance_to_shapes(known.points + base, scene.obstacles).min(axis=1) > 1e-3).all()
    then = known.scene(aims, 0.01)
    boxes = then.clutter[len(scene.clutter) :]
    assert (distance_to_shapes(known.points + base, boxes).min(axis=1) < 1e-9).all()
    assert then.occupancy is not None
    assert then.occupancy.states.astype(bool).sum() > told.occupancy.states.astype(bool).sum()  # type: ignore[union-attr]
    assert len(known.unobserved(way)) < len(dark)
    first = LocalMap(Problem(told, TARGET, ARM, env.start), target, CAMERA)
    assert 0 < len(known.unobserved_around_target()) < len(first.unobserved_around_target())
    tip = arm.centers(way[1:])[0, -1]
    known.points = tip[None] + [arm.radius[-1] + CLEARANCE / 2, 0.0, 0.0]
    assert known.blocked(way)
    assert not known.blocked(way[1:]), "what the arm is at already does not keep it there"
    env.close()


def test_the_aisle_behind_the_arm_is_free_and_nothing_else_that_is_unknown(scene: Scene) -> None:
    told = known_where(scene, 0.0)
    base = base_position(scene, ARM)
    known = LocalMap(Problem(told, TARGET, ARM, START), scene.tomatoes[TARGET].center - base, CAMERA)
    before, now = told.occupancy, known.scene(START, 0.01).occupancy
    assert before is not None
    assert now is not None
    ahead = before.centers[..., 0] - base[0]
    changed = now.states != before.states
    assert changed.any()
    assert (now.states[changed] == FREE).all()
    assert ((ahead[changed] > -0.5) & (ahead[changed] < -0.1)).all()
    assert (now.states[(ahead > -0.5) & (ahead < -0.1)] != UNKNOWN).all()


def test_a_surface_without_a_shape_is_dark_until_the_camera_has_looked(scene: Scene, arm: ArmSpheres) -> None:
    env = GreenhouseEnv(bank="mini", start="upright", observation="depth")
    target = scene.tomatoes[TARGET].center - base_position(scene, ARM)
    space = known_where(scene, None).occupancy
    assert space is not None
    told = with_surface_at(scene, space.centers.reshape(-1, 3))
    aims = first_viewpoint(0.8 * target)
    observation, _ = env.reset(options={"scene": scene, "target": TARGET, "start": aims})
    way = np.linspace(aims, aims + [0.0, 0.3, 0.0, 0.0, 0.0, 0.0], 20)
    problem = Problem(told, TARGET, ARM, env.start)
    known = LocalMap(problem, target, CAMERA, unexplained=True)
    emptied = LocalMap(replace(problem, scene=known_where(scene, None)), target, CAMERA)
    before = known.unobserved(way)
    assert len(before) > 0
    assert len(emptied.unobserved(way)) == 0, "all of it was seen"
    known.add(observation["depth"][0] * MAX_RANGE, aims)
    assert len(known.unobserved(way)) < len(before)
    assert unexplained_cells(known.scene(aims, 0.01)).sum() < unexplained_cells(told).sum()
    env.close()


def test_a_view_shows_what_is_before_the_camera_and_not_hidden(arm: ArmSpheres) -> None:
    places = np.random.default_rng(1).uniform([0.4, -0.3, 0.1], [0.7, 0.3, 0.6], (40, 3))
    sees = partial(visible, arm, points=places)
    found = list(viewpoints(ARM, START, sees, np.random.default_rng(0)))
    assert len(found) > 10
    assert all(seen.mean() >= MIN_GAIN for _, seen in found)
    best = np.array([view for view, _ in found])
    seen = visible(arm, best, places)
    assert np.array_equal(seen, [shown for _, shown in found])
    assert not visible(arm, best, places + [2 * DEPTHS[1], 0, 0]).any()
    wall = OpaqueCells(np.ones((1, 1, 1), dtype=bool), np.array([0.3, -5.0, -5.0]), 10.0)
    behind = visible(arm, best, places, wall)
    assert behind.sum() < seen.sum()
    assert not (behind & ~seen).any()


def test_a_view_is_that_of_samples_along_each_line_of_sight(arm: ArmSpheres) -> None:
    random = np.random.default_rng(2)
    configurations = ARM.starts["ready"] + random.normal(0, 0.3, (20, 6))
    places = random.uniform([0.3, -0.6, -0.6], [1.2, 0.6, 0.3], (80, 3))
    cells = random.uniform(size=(8, 9, 7)) < 0.15
    turn = pose(rotation_about([0.2, 0.1, 1.0], 0.4), [0.1, 0.2, 0.7])
    grid = OpaqueCells(cells, np.array([0.2, -0.4, 0.0]), 0.15, turn)
    seen, all_in_view = visible(arm, configurations, places, grid), visible(arm, configurations, places)
    _, origins = wrist_camera(arm.chain, configurations)
    expected = all_in_view.copy()
    for m, k in np.argwhere(all_in_view):
        offset = places[k] - origins[m]
        length = np.linalg.norm(offset)
        along = np.arange(0.04, length - 0.08, 0.04)
        found = cells_of(transform(turn, origins[m] + along[:, None] / length * offset), grid.low, cells.shape, 0.15)
        expected[m, k] = not cells.reshape(-1)[found[found >= 0]].any()
    assert 0.2 < expected.sum() / all_in_view.sum() < 0.95
    assert (seen != expected).sum() <= 1  # a sample may lie at the face of a cell


def test_images_that_it_does_not_read_are_not_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    rendered: list[bool] = []
    render = CameraRig.render

    def counted(rig: CameraRig, *arguments: Any) -> Any:
        rendered.extend(arguments[-1])
        return render(rig, *arguments)

    def outcomes(num_envs: int) -> list[tuple[int, bool, int, float, str]]:
        rendered.clear()
        records = evaluate(WatchfulAgent(), "train", episodes=3, bank="mini", num_envs=num_envs, progress=False).records
        return [(r.seed, r.success, r.steps, r.joint_length, r.status) for r in records]

    monkeypatch.setattr(CameraRig, "render", counted)
    lazy = outcomes(1)
    assert 0.4 < np.mean(rendered) < 0.7
    count = len(rendered)
    assert outcomes(3) == lazy
    with monkeypatch.context() as patched:
        patched.setattr(WatchfulAgent, "reads_images", True)
        assert outcomes(1) == lazy
    assert all(rendered)
    assert len(rendered) == count
    assert any(steps > 30 for _, _, steps, _, _ in lazy)


def test_the_initial_view_moves_the_wrist_only(arm: ArmSpheres) -> None:
    target = np.array([0.5, 0.2, 0.3])
    view = initial_view(arm, ARM, START, target)
    assert set((view != START).nonzero()[0]) <= {3, 4}
    state = tool_state(arm.chain, view[None])
    offset = (target - state.point)[0]
    assert float(state.axis[0] @ offset) > 0.7 * np.linalg.norm(offset)


def first_viewpoint(point: np.ndarray) -> np.ndarray:
    """The best configuration (j,) to look at a point (3,) that nothing occludes."""
    sees = partial(visible, arm_spheres(ARM), points=point[None])
    return next(viewpoints(ARM, START, sees, np.random.default_rng(0)))[0]
