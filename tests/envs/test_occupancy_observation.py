"""The observation of unknown space, and the start configurations of the arm."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from greenhouse_gym.envs import EnvSettings, GreenhouseEnv, GreenhouseVectorEnv
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import SceneBank

ARM = get_robot("ur5e")


def test_the_places_of_the_probe_points_are_told() -> None:
    check_env(
        gymnasium.make("TomatoReach-v0", bank="mini", observation="state_occupancy").unwrapped, skip_render_check=True
    )
    env, plain = GreenhouseEnv(bank="mini", observation="state_occupancy"), GreenhouseEnv(bank="mini")
    values, known = set(), len(plain.reset(seed=4)[0])
    observed = env.reset(seed=4)[0]
    for _ in range(60):
        model, data = env.model_and_data()
        places = np.array([data.site(model.site(name).id).xpos for name in ARM.probes])
        assert env.scene.occupancy is not None
        np.testing.assert_array_equal(observed[known:], ~env.scene.occupancy.is_known(places))
        values.update(observed[known:].tolist())
        observed, _, terminated, *_ = env.step(np.array([0.6, 0.3, 0.0, 0.0, 0.0, 0.0]))
        if terminated:
            break
    assert values == {0.0, 1.0}  # the arm turned into what was not seen
    np.testing.assert_array_equal(env.reset(seed=4)[0][:known], plain.reset(seed=4)[0])


def test_many_simulations_are_told_what_one_is() -> None:
    many = GreenhouseVectorEnv(3, bank="mini", observation="state_occupancy")
    singles = [GreenhouseEnv(bank="mini", observation="state_occupancy") for _ in range(3)]
    np.testing.assert_array_equal(many.reset(seed=7)[0], [env.reset(seed=7 + i)[0] for i, env in enumerate(singles)])


def test_scenes_that_do_not_know_are_named(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, observation="state_occupancy")
    with pytest.raises(InvalidValueError, match=r"made-up-\d.*no occupancy grid.*state"):
        env.reset(seed=0)


def test_the_start_is_a_setting_that_a_reset_may_change(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, start="folded")
    env.reset(seed=0)
    np.testing.assert_array_equal(env.start, ARM.starts["folded"])
    env.reset(seed=0, options={"start": ARM.start})
    np.testing.assert_array_equal(env.start, ARM.start)
    angles = ARM.start + 0.1
    assert EnvSettings(start=angles) == EnvSettings(start=tuple(angles.tolist()))
    vector = GreenhouseVectorEnv(2, bank=bank, start=angles)
    vector.reset(seed=0)
    np.testing.assert_array_equal(vector.simulation.joints, [angles, angles])


def test_wrong_starts_are_refused_when_the_environment_is_made(bank: SceneBank) -> None:
    with pytest.raises(UnknownNameError, match=r"'lying'.*folded"):
        GreenhouseEnv(bank=bank, start="lying")
    for wrong in ([0.0], [np.nan] * 6, [9.0] * 6, 3, ["a"] * 6):
        with pytest.raises(InvalidValueError, match="start"):
            GreenhouseEnv(bank=bank, start=wrong)
