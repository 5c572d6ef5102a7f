from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest

from greenhouse_gym.envs import TomatoReachVectorEnv, worlds
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import SceneBank, Shapes
from greenhouse_gym.scene.bank import write_bank


def test_old_worlds_make_room_unless_somebody_is_in_them(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds, "KEPT", 2)
    kept = worlds.Worlds(get_robot("ur5e"), "reconstruction", 300)
    in_use = kept.world(bank[0])
    for scene in bank:
        kept.world(scene)
    gc.collect()
    assert len(kept.fields) == 3  # the last two, and the one in use
    assert kept.world(bank[0]) is in_use
    again = kept.world(bank[1])
    assert again.scene is bank[1]
    del in_use, again
    kept.world(bank[2]), kept.world(bank[3])
    gc.collect()
    assert len(kept.fields) == 2


def test_a_scene_with_more_obstacles_than_fit_names_both_numbers(bank: SceneBank) -> None:
    env = TomatoReachVectorEnv(2, bank=bank, capacity=5)
    with pytest.raises(InvalidValueError, match="more than the 5 allowed"):
        env.reset(seed=0)
    roomy = TomatoReachVectorEnv(2, bank=bank, capacity=50)
    usual = TomatoReachVectorEnv(2, bank=bank)
    np.testing.assert_array_equal(roomy.reset(seed=0)[0], usual.reset(seed=0)[0])


def test_truth_chooses_its_capacity_from_the_bank(bank: SceneBank, tmp_path: Path) -> None:
    crowd = tuple(Box([2.0, 0.01 * k, 1.0], [0.01, 0.001, 0.01], np.eye(3)) for k in range(333))
    scenes = [scene.model_copy(update={"truth": Shapes(tomatoes=scene.tomatoes, clutter=crowd)}) for scene in bank]
    true = write_bank(tmp_path, [(scene, bank.split_of(scene.name)) for scene in scenes], name="true")
    assert true.largest_truth() == 333 + 12
    env = TomatoReachVectorEnv(2, bank=true, physics="truth")
    env.reset(seed=0)
    assert env.simulation.worlds.capacity == 400
    assert worlds.room_for(true, "reconstruction") == worlds.room_for(bank, "truth") == 300
    with pytest.raises(InvalidValueError, match=r"made-up-\d.*no truth.*simulated"):
        TomatoReachVectorEnv(2, bank=bank, physics="truth").reset(seed=0)
