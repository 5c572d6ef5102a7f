from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from conftest import make_scene

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box
from greenhouse_gym.motion.caution import with_margin
from greenhouse_gym.motion.clearance import path_clearance
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.planning import plan
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, compile_scene

ARM = get_robot("ur5e")


def leaf(center: Any) -> Box:
    return Box(center, [0.05, 0.05, 0.003], np.eye(3))


def among_leaves(seed: int = 0) -> Scene:
    """A scene with leaves before its tomatoes."""
    scene = make_scene(seed)
    before = [leaf(tomato.center + [-0.12, 0.0, 0.06]) for tomato in scene.tomatoes]
    return scene.model_copy(update={"clutter": (*scene.clutter, *before)})


def leaves_only(scene: Scene) -> Scene:
    boxes = tuple(shape for shape in scene.clutter if isinstance(shape, Box))
    return scene.model_copy(update={"clutter": boxes, "stems": (), "tomatoes": scene.tomatoes[4:5], "targets": ()})


def test_paths_keep_the_margin_from_boxes() -> None:
    gains = []
    for seed, margin in itertools.product(range(3), (0.0, 0.02)):
        scene = among_leaves(seed)
        result = plan(scene, 4, time_limit=60.0, max_checks=20_000, goals=20, seed=seed, margin=margin)
        assert result.path is not None
        gap = path_clearance(compile_scene(leaves_only(scene), "ur5e"), 0, result.path)
        assert gap >= margin
        gains.append(gap)
    assert min(gains[::2]) < 0.02, "without a margin some path comes nearer than that"


def test_without_a_margin_nothing_changes() -> None:
    scene = among_leaves()
    assert with_margin(scene, ARM, ARM.start, 0.0) is scene


def test_a_leaf_beside_the_start_stays_as_it_is() -> None:
    scene = among_leaves()
    beside = next(
        box
        for height in np.arange(2.2, 1.0, -0.004)
        if not _is_free(with_leaf(scene, box := leaf([0.0, 0.0, height - 0.012])))
        and _is_free(with_leaf(scene, box := leaf([0.0, 0.0, height + 0.012])))
    )
    crowded = with_leaf(scene, beside)
    grown = with_margin(crowded, ARM, ARM.start, 0.03)
    np.testing.assert_array_equal(grown.clutter[-1].half_extents, beside.half_extents)
    np.testing.assert_allclose(grown.clutter[0].half_extents, np.array(crowded.clutter[0].half_extents) + 0.03)
    assert [type(shape) for shape in grown.clutter] == [type(shape) for shape in crowded.clutter]
    result = plan(crowded, 4, time_limit=60.0, max_checks=20_000, goals=20, margin=0.02)
    assert result.path is not None


def with_leaf(scene: Scene, box: Box) -> Scene:
    return scene.model_copy(update={"clutter": (*scene.clutter, box)})


def _is_free(scene: Scene) -> bool:
    return CollisionChecker(planning_model(compile_scene(scene, ARM), 0), arm_reaches(ARM)).is_free(ARM.start)


@pytest.mark.parametrize("margin", [-0.01, np.nan, np.inf])
def test_margins_that_make_no_sense_are_named(margin: float) -> None:
    with pytest.raises(InvalidValueError, match="margin"):
        plan(among_leaves(), 4, max_checks=100, margin=margin)
