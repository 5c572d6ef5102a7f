"""Fruit of a scan that are followed in images while their trusses rise, turn and lose fruit."""

import numpy as np
import pytest

from greenhouse_gym.agents.harvest.fruit_map import FruitMap
from greenhouse_gym.agents.harvest.scanned_trusses import scanned_trusses
from greenhouse_gym.agents.harvest.sphere_search import fitted_center, spheres_on
from greenhouse_gym.agents.harvest.truss_pose import SkinImage, Truss, fitted
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Sphere, rotation_about
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.scene.obstacles import Surroundings

CAMERA = DepthCamera("wrist", 64, 48)
ROOT = np.array([0.60, 0.0, 1.0])
HANGING = np.array(
    [[0.50, 0.0, 0.93], [0.50, 0.035, 0.92], [0.49, -0.035, 0.91], [0.50, 0.015, 0.88], [0.49, -0.02, 0.87]]
)
RADIUS = 0.015
LOOKING = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # scene_from_camera: along x, z is up
ORIGIN = np.array([0.3, 0.0, 0.92])
RISE = np.array([0.0, 1.0, 0.0])  # axis about which a truss to the left of its root rises


def scene(centers=HANGING):
    """Return a scene with a truss on a main stem."""
    stems = (
        Stem(np.array([0.6, 0.0, 0.2]), np.array([0.6, 0.0, 1.6]), 0.006, "main"),
        Stem(np.array([0.59, 0.0, 1.0]), np.array([0.54, 0.0, 0.98]), 0.002, "peduncle"),
        Stem(np.array([0.54, 0.0, 0.98]), np.array([0.5, 0.0, 0.95]), 0.002, "peduncle"),
    )
    tomatoes = tuple(Tomato(Sphere(center, RADIUS), 7, 0.9) for center in centers)
    return Surroundings(name="one truss", tomatoes=tomatoes, stems=stems)


def turned(angle, axis=RISE, centers=HANGING):
    return ROOT + (centers - ROOT) @ rotation_about(axis, angle).T


def picture(centers, radius=RADIUS):
    """Return depth (m,) and color (m, 3) of an image of red spheres before a far wall."""
    rays = CAMERA.rays @ LOOKING.T
    lengths = np.linalg.norm(rays, axis=1)
    offsets = np.asarray(centers) - ORIGIN
    along = (rays / lengths[:, None]) @ offsets.T
    across = (offsets * offsets).sum(axis=1) - along**2
    ranges = np.where(across < radius**2, along - np.sqrt(np.maximum(radius**2 - across, 0)), np.inf).min(axis=1)
    red = np.isfinite(ranges)
    depth = np.where(red, ranges, 1.2) / lengths
    return rays, depth, np.where(red[:, None], [200, 30, 20], [90, 120, 90]).astype(np.uint8)


def see(fruit, centers, times=1, held=None):
    for _ in range(times):
        rays, depth, color = picture(centers)
        fruit.see(rays, ORIGIN, depth, color, held)


def errors(fruit, centers):
    return np.linalg.norm(fruit.centers[: len(centers)] - centers, axis=1)


def test_a_truss_turns_about_where_its_rachis_leaves_the_main_stem():
    trusses = scanned_trusses(scene())
    np.testing.assert_allclose(trusses.roots, [ROOT], atol=0.011)
    assert trusses.of.tolist() == [0] * 5
    assert trusses.stems.tolist() == [-1, 0, 0]


def test_trusses_without_any_stem_hang_above_their_fruit():
    bare = scene().model_copy(update={"stems": ()})
    roots = scanned_trusses(bare).roots
    assert roots[0, 2] > HANGING[:, 2].max()
    assert scanned_trusses(bare.model_copy(update={"tomatoes": ()})).roots.shape == (0, 3)


@pytest.mark.parametrize("angle", [0.0, 0.1, -0.1])
def test_a_truss_in_view_is_followed(angle):
    fruit = FruitMap(scene())
    for fraction in np.linspace(0.25, 1.0, 4):
        see(fruit, turned(fraction * angle), 2)
    assert errors(fruit, turned(angle)).max() < 0.004


@pytest.mark.parametrize("angle", [0.45, 0.8])
def test_a_truss_that_rose_out_of_view_is_found_again(angle):
    fruit = FruitMap(scene())
    see(fruit, turned(angle), 8)
    assert errors(fruit, turned(angle)).max() < 0.006


def test_a_truss_rises_in_the_map_as_fruit_are_picked():
    fruit = FruitMap(scene())
    before = fruit.centers.copy()
    fruit.pick(0)
    assert not fruit.hanging[0]
    assert (fruit.centers[1:, 2] > before[1:, 2] + 0.002).all()
    again = fruit.centers.copy()
    fruit.pick(0)
    np.testing.assert_array_equal(fruit.centers, again, "a fruit is picked once")
    np.testing.assert_allclose(fruit.joint(1) - fruit.trusses.roots[0], fruit.turns[0] @ (
        FruitMap(scene()).joint(1) - fruit.trusses.roots[0]))  # fmt: skip


def test_a_truss_whose_fruit_is_borne_rises_before_it_is_picked_and_not_again():
    fruit = FruitMap(scene())
    jump = fruit.jump(0)
    fruit.relieve(0)
    assert fruit.centers[0, 2] - HANGING[0, 2] == pytest.approx(jump, rel=0.1)
    raised = fruit.centers.copy()
    fruit.pick(0)
    np.testing.assert_array_equal(fruit.centers, raised)


def test_a_fruit_that_is_gone_is_missed():
    fruit = FruitMap(scene())
    see(fruit, HANGING, 2)
    see(fruit, HANGING[1:], 30)
    assert fruit.hanging.tolist() == [False, True, True, True, True]
    assert errors(fruit, HANGING)[1:].max() < 0.004


def test_fruit_that_the_scan_lacks_are_added_and_move_with_their_truss():
    fruit = FruitMap(scene(HANGING[:3]))
    see(fruit, HANGING, 3)
    assert len(fruit.radii) == 5
    assert fruit.of.tolist() == [0] * 5
    extra = fruit.centers[3:]
    assert np.linalg.norm(extra[:, None] - HANGING[3:], axis=2).min(axis=1).max() < 0.004
    for angle in (0.04, 0.08, 0.12):
        see(fruit, turned(angle), 2)
    assert errors(fruit, turned(0.12)[:3]).max() < 0.004
    assert np.linalg.norm(fruit.centers[3:, None] - turned(0.12)[3:], axis=2).min(axis=1).max() < 0.005


def test_skin_of_a_held_fruit_says_nothing_about_those_that_hang():
    fruit = FruitMap(scene())
    moved = HANGING.copy()
    moved[0] = [0.42, 0.05, 0.90]
    see(fruit, moved, 6, held=(0, moved[0]))
    assert errors(fruit, HANGING)[1:].max() < 0.003


def test_a_truss_bears_a_fruit_again_that_was_not_picked_after_all():
    fruit = FruitMap(scene())
    before = fruit.centers.copy()
    fruit.pick(1)
    assert not fruit.hanging[1]
    risen = fruit.centers[:, 2] - before[:, 2]
    assert (risen > 0.001).any()
    fruit.pick(1)  # it rises once
    np.testing.assert_allclose(fruit.centers[:, 2] - before[:, 2], risen)
    fruit.hang(1)
    assert fruit.hanging.all()
    np.testing.assert_allclose(fruit.centers, before, atol=1e-12)
    fruit.hang(1)
    np.testing.assert_allclose(fruit.centers, before, atol=1e-12)


def test_a_scale_corrects_the_radius_of_a_fruit_within_reason():
    fruit = FruitMap(scene())
    weight = fruit.weights[2]
    fruit.weigh(2, 1.5 * weight)
    assert fruit.radii[2] == pytest.approx(RADIUS * 1.5 ** (1 / 3))
    assert fruit.weights[2] == pytest.approx(1.5 * weight)
    assert fruit.radii[1] == RADIUS
    fruit.weigh(1, -3.0)
    assert 0.5 * RADIUS < fruit.radii[1] < RADIUS
    fruit.weigh(0, 100 * weight)
    assert RADIUS < fruit.radii[0] < 1.5 * RADIUS


def test_an_image_without_red_skin_changes_nothing():
    fruit = FruitMap(scene())
    rays = CAMERA.rays @ LOOKING.T
    fruit.see(rays, ORIGIN, np.zeros(len(rays)), np.zeros((len(rays), 3), dtype=np.uint8), None)
    np.testing.assert_array_equal(fruit.centers, HANGING)


def test_a_pose_is_only_left_for_a_clearly_better_one():
    rays, depth, color = picture(HANGING)
    lengths = np.linalg.norm(rays, axis=1)
    image = SkinImage(ORIGIN, rays / lengths[:, None], depth * lengths, color[:, 0] > 150)
    truss = Truss(ROOT, HANGING, np.full(5, RADIUS))
    turn, reliable = fitted(image, truss, np.eye(3), np.full(int(image.skin.sum()), np.inf), search=True)
    np.testing.assert_allclose(turn, np.eye(3), atol=0.01)
    assert reliable


def test_the_middle_of_a_fruit_is_fitted_to_half_of_its_skin():
    rng = np.random.default_rng(0)
    skin = rng.normal(size=(60, 3))
    skin = 0.03 * skin / np.linalg.norm(skin, axis=1, keepdims=True)
    skin[:, 0] = -np.abs(skin[:, 0])
    center = np.array([0.5, 0.1, 1.0])
    np.testing.assert_allclose(fitted_center(skin + center, center + [0.008, -0.006, 0.004], 0.03), center, atol=1e-3)


def test_spheres_are_found_on_skin_alone_and_not_twice():
    rays, depth, color = picture(HANGING)
    points = (ORIGIN + depth[:, None] * rays)[color[:, 0] > 150]
    found = spheres_on(points, ORIGIN, RADIUS, np.empty((0, 3)))
    assert 4 <= len(found) <= 5
    assert np.linalg.norm(np.array(found)[:, None] - HANGING, axis=2).min(axis=1).max() < 0.004
    assert not spheres_on(points, ORIGIN, RADIUS, HANGING)
