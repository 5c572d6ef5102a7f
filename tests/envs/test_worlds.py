from __future__ import annotations

import gc

import numpy as np
import pytest

from greenhouse_gym.envs import TomatoReachVectorEnv, worlds
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import SceneBank


def test_old_worlds_make_room_unless_somebody_is_in_them(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds, "KEPT", 2)
    kept = worlds.Worlds(get_robot("ur5e"), "reconstruction", None)
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
