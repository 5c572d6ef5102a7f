from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_scene

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box
from greenhouse_gym.motion.collision import CollisionChecker
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Shapes, compile_scene
from greenhouse_gym.scene.truth import start_is_collision_free, true_scene


def test_the_truth_takes_the_place_of_the_scan() -> None:
    scene = make_scene(0)
    truth = Shapes(tomatoes=scene.tomatoes[:1])
    true = true_scene(scene.model_copy(update={"truth": truth}))
    assert (true.name, true.counts, true.stems, true.clutter, true.targets) == (scene.name, (1, 0, 0), (), (), ())
    np.testing.assert_array_equal(true.tomatoes[0].center, scene.tomatoes[0].center)
    with pytest.raises(InvalidValueError, match="carries no truth"):
        true_scene(scene)


@pytest.mark.parametrize("robot", ["ur5e", "iiwa14"])
def test_an_arm_is_put_up_where_it_touches_no_true_plant(robot: str) -> None:
    scene = make_scene(0)
    assert start_is_collision_free(scene, robot), "nothing is known of a truth"
    for height, free in ((1.5, False), (4.0, True)):
        leaf = Box([0.0, 0.0, height], [0.2, 0.2, 0.001], np.eye(3))
        truth = Shapes(tomatoes=scene.tomatoes[:1], clutter=(leaf,))
        assert start_is_collision_free(scene.model_copy(update={"truth": truth}), robot) == free


def test_what_an_arm_touches_of_itself_or_its_cart_is_no_plant() -> None:
    arm = get_robot("ur5e")
    bent = replace(arm, start=np.array([0.0, 1.5, 0.0, 0.0, 0.0, 0.0]))  # straight down
    scene = make_scene(0)
    true = scene.model_copy(update={"truth": Shapes(tomatoes=scene.tomatoes[:1])})
    assert not CollisionChecker(compile_scene(true_scene(true), bent).model).is_free(bent.start)
    assert start_is_collision_free(true, bent)
