from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.crop import Tomato
from greenhouse_gym.planning import CollisionChecker, certify, certify_targets, planning_model
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, Target
from greenhouse_gym.scene.mjcf import compile_scene


@pytest.fixture(scope="module")
def small(scene: Scene) -> Scene:
    """Two tomatoes of a scene and one that is out of reach."""
    tomatoes = (scene.tomatoes[0], scene.tomatoes[4], Tomato([3.0, 0.0, 1.0], 0.03, truss=9))
    return scene.model_copy(update={"tomatoes": tomatoes, "targets": ()})


@pytest.fixture(scope="module")
def targets(small: Scene) -> tuple[Target, ...]:
    return certify_targets(small)


def test_every_tomato_is_rated(targets: tuple[Target, ...]) -> None:
    assert [t.tomato for t in targets] == [0, 1, 2]
    assert targets[0].difficulty == "easy"
    assert targets[1].difficulty in ("easy", "medium")
    assert targets[2] == Target(tomato=2, difficulty="unreachable")


def test_witnesses_are_free_and_end_at_the_target(small: Scene, targets: tuple[Target, ...]) -> None:
    compiled = compile_scene(small)
    for target in targets[:2]:
        path = np.array(target.witness)
        assert np.array_equal(path, path.round(6))
        np.testing.assert_allclose(path[0], get_robot("ur5e").start, atol=1e-6)
        simulator = CollisionChecker(planning_model(compiled, target.tomato, margin=0.0))
        assert simulator.path_is_free(path, 0.002)


def test_same_seed_same_certificates_and_they_survive_the_file(small: Scene, targets: tuple[Target, ...]) -> None:
    assert certify_targets(small) == targets
    certified = small.model_copy(update={"targets": targets})
    assert Scene.model_validate_json(certified.model_dump_json()).targets == targets


def test_the_checks_decide(small: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(certify, "EASY", 1)
    monkeypatch.setattr(certify, "MEDIUM", 2)
    assert certify_targets(small)[0].difficulty == "hard"
    monkeypatch.setattr(certify, "MAX_CHECKS", 10)
    assert certify_targets(small)[0].difficulty == "unreachable"
