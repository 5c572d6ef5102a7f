"""A scanned stand as the scanning harvester knows it: trusses that rose, fruit and obstacles that the scan lacks."""

import numpy as np
import pytest

from greenhouse_gym.agents import Problem
from greenhouse_gym.agents.harvest.scan_harvester import ScanHarvester
from greenhouse_gym.agents.harvest.scanned_stand import ScannedStand
from greenhouse_gym.crops.parts import SpaceBox, is_leaf
from greenhouse_gym.envs import make_env
from greenhouse_gym.geometry import Box
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.scene import SceneBank

SCENE = "own-cluster-2000-w00-02"


@pytest.fixture
def stand():
    """Return a stand whose hand has sensed once."""
    agent = ScanHarvester()
    env = make_env(bank="mini", scene=SCENE, **agent.env_options)
    observation, _ = env.reset(seed=0)
    problem = Problem.of(env.simulation, 0, 0)
    agent.reset(problem)
    agent.act(observation)
    hand = agent._hand
    hand.surface.points, hand.surface.broad = np.empty((0, 3)), np.empty(0, dtype=bool)
    return ScannedStand(problem, hand)


def in_scene(stand, points):
    return points @ stand._hand.turn.T + stand._hand.base


def test_what_the_camera_sees_is_in_the_way_and_gives_way_where_it_is_broad(stand):
    before = stand.scene(0.0, seen=True)
    axes = np.arange(0.4, 0.6, 0.02), np.arange(-0.4, 0.4, 0.05), np.arange(-0.3, 0.3, 0.05)
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    apart = np.linalg.norm(before.arrays.starts[:, None] - in_scene(stand, grid), axis=2).min(axis=0)
    free = grid[apart.argmax()]
    stand._hand.surface.points = free + [[0.0, 0.0, 0.0], [0.0, 0.05, 0.0], [-0.9, 0.0, 0.0]]
    stand._hand.surface.broad = np.array([True, False, False])
    after = stand.scene(0.0, seen=True)
    new = [piece for piece in after.clutter if isinstance(piece, Box) and piece.half_extents.max() < 0.013]
    new = [box for box in new if np.linalg.norm(box.center - in_scene(stand, free)) < 0.08]
    assert sorted(isinstance(box, SpaceBox) for box in new) == [False, True], "those behind the arm do not count"
    assert [is_leaf(box) for box in sorted(new, key=lambda box: isinstance(box, SpaceBox))] == [True, False]
    assert len(stand.scene(0.0).clutter) == len(before.clutter)


def test_a_path_is_blocked_by_leaves_only_where_they_count(stand):
    robot = stand._problem.robot
    arm, rng = arm_spheres(robot), np.random.default_rng(0)
    configurations = rng.uniform(robot.lower, robot.upper, (50, len(robot.joints)))
    centers = arm.centers(configurations)[:, arm.moving]
    ahead = (centers[..., 0] > 0.35) & (centers[..., 2] > -0.6)  # where plants are
    stand._hand.surface.points = np.array([centers[ahead][0]])
    reaches = configurations[[int(np.argwhere(ahead)[0, 0])]]
    for broad, leaves, blocked in ((True, True, True), (True, False, False), (False, False, True)):
        stand._hand.surface.broad = np.array([broad])
        assert stand.blocks(reaches, leaves) == blocked
    stand._hand.surface.points = np.array([[2.0, 0.0, 0.0]])
    assert not stand.blocks(reaches, leaves=True), "out of reach"


def test_nothing_is_where_the_arm_is(stand):
    hand, robot = stand._hand, stand._problem.robot
    arm = arm_spheres(robot)
    inside = in_scene(stand, arm.centers(hand.command[None])[0][arm.moving][5])
    hand.fruit.centers[3] = inside
    assert stand.scene(0.0).tomatoes[3].center[2] > 5, "not there"
    np.testing.assert_allclose(stand.scene(0.0, target=3).tomatoes[3].center, inside)
    assert len(stand._outside(list(stand._problem.scene.stems))) == len(stand._problem.scene.stems)
    stem = stand._problem.scene.stems[0]
    moved = type(stem)(inside, inside + [0.0, 0.0, 0.1], stem.radius, stem.kind)
    assert stand._outside([stem, moved]) == [stem]


def test_fruit_that_the_scan_lacks_and_trusses_that_rose_are_in_the_scene(stand):
    fruit, scanned = stand._hand.fruit, stand._problem.scene
    truss = int(fruit.of[0])
    fruit.relieve(0)
    scene = stand.scene(0.0)
    mine = fruit.trusses.stems == truss
    assert mine.any()
    starts, before = (np.array([stem.start for stem in stems]) for stems in (scene.stems, scanned.stems))
    np.testing.assert_array_equal(starts[~mine], before[~mine])
    assert (starts[mine] != before[mine]).any()
    fruit.centers = np.vstack([fruit.centers, [0.6, 0.3, 1.2]])
    fruit.radii, fruit.of = np.append(fruit.radii, 0.02), np.append(fruit.of, truss)
    fruit._picked, fruit._through = np.append(fruit._picked, False), np.append(fruit._through, 0)
    extra = stand.scene(0.0, apart=0.01).tomatoes[len(scanned.tomatoes)]
    np.testing.assert_array_equal(extra.center, [0.6, 0.3, 1.2])
    assert extra.radius == pytest.approx(0.03)


def test_links_move_no_nearer_to_known_fruit_but_to_those_of_the_truss_in_work(stand):
    hand, robot = stand._hand, stand._problem.robot
    arm, step = arm_spheres(robot), np.zeros(len(robot.joints))
    step[0] = 0.1
    links = [in_scene(stand, arm.centers(q[None])[0][arm.moving]) for q in (hand.command, hand.command + step)]
    reach = arm.radius[arm.moving] + hand.fruit.radii[0]
    ways = links[1] - links[0]
    centers = links[1] + (reach + 0.003)[:, None] * ways / np.linalg.norm(ways, axis=1, keepdims=True)

    def gaps(positions):
        return (np.linalg.norm(positions - centers[:, None], axis=2) - reach).min(axis=1)

    ahead = np.flatnonzero((gaps(links[0]) > 0.01) & (gaps(links[1]) > 0.0))[0]
    hand.fruit.centers[0] = centers[ahead]
    other = int(np.flatnonzero(hand.fruit.of != hand.fruit.of[0])[0])
    assert stand.nearer(other, hand.command, step)
    assert not stand.nearer(other, hand.command, -step)
    assert not stand.nearer(0, hand.command, step), "its own truss"


def test_the_arm_keeps_from_the_whole_gutter_and_from_itself(stand):
    (scanned,) = stand._gutter
    (true,) = (piece for piece in SceneBank.open("mini").scene(SCENE).truth.clutter if not is_leaf(piece))
    assert (np.abs(true.center - scanned.center) + true.half_extents <= scanned.half_extents + 0.01).all(), "within"
    top = [box.center[2] + box.half_extents[2] for box in (scanned, true)]
    np.testing.assert_allclose(top[0], top[1], atol=0.02)
    np.testing.assert_allclose(scanned.half_extents[0], true.half_extents[0], atol=0.02)
    problem = stand._problem
    robot = problem.robot
    goal = np.random.default_rng(0).uniform(robot.lower, robot.upper)  # somewhere on the way the arm meets something
    path = problem.start + np.linspace(0, 1, 2000)[:, None] * (goal - problem.start)
    wide, tight = ([checker.is_free(q) for q in path] for checker in stand._checkers)
    between = next(k for k in range(len(path)) if tight[k] and not wide[k])
    touching = next(k for k in range(between, len(path)) if not tight[k])
    assert not stand.stops(path[0], path[1] - path[0])
    assert stand.stops(path[between - 1], path[between] - path[between - 1])
    assert stand.stops(path[between], path[touching] - path[between]), "near itself, it comes no nearer"
    assert not stand.stops(path[between], path[0] - path[between])
