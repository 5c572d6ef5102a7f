"""The teacher of picking: it picks, the same alone and among others, and is refused where it cannot teach."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.envs import make_env, make_vec_env
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.learning import BcThenPpoSettings, PpoSettings
from greenhouse_gym.learning.picking_teacher import picking_labels
from greenhouse_gym.learning.settings import ImitationSettings

OPTIONS = {
    "bank": "mini", "scene": "own-cluster-2000-w00-02", "task": "harvest", "plants": "compliant", "physics": "truth",
    "action": "tip_velocity",
}  # fmt: skip


def test_it_brings_a_fruit_into_the_crate_and_lets_go_only_there():
    env = make_env(**OPTIONS)
    env.reset(seed=0)
    held, over = [], False
    while not over:
        action = picking_labels(env.simulation)[0]
        assert np.abs(action).max() <= 1
        held.append(env.simulation.state.plants["held"][0])
        _, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    assert info["is_success"]
    assert info["dropped"] == 0
    assert np.abs(np.diff(held)).sum() == 2, "held once, let go once"


def test_what_it_does_in_a_simulation_does_not_depend_on_the_others():
    both, alone = make_vec_env(2, **OPTIONS), make_env(**OPTIONS)
    both.reset(seed=3)
    alone.reset(seed=4)
    for _ in range(5):
        labels = picking_labels(both.simulation)
        np.testing.assert_array_equal(labels[1], picking_labels(alone.simulation)[0])
        both.step(labels)
        alone.step(labels[1])


@pytest.mark.parametrize("wrong", [{"task": "reach"}, {"plants": "rigid"}, {"action": "joint"}])
def test_it_teaches_motions_of_the_tip_in_the_harvest_alone(wrong):
    ppo = PpoSettings(**{"task": "harvest", "plants": "compliant", "action": "tip_velocity"} | wrong)
    with pytest.raises(InvalidValueError, match=f"{next(iter(wrong))}="):
        BcThenPpoSettings(0, ImitationSettings(teacher="picking"), ppo, from_rule=False)
    with pytest.raises(UnknownNameError, match="teacher"):
        ImitationSettings(teacher="oracle")
