"""Settings: what is refused, the success radius, the step limit and the rate."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import pytest
from reach_helpers import scene_of
from test_environment import make_for
from test_vector import compare_with_singles

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.envs import EnvSettings, GreenhouseEnv, GreenhouseVectorEnv
from greenhouse_gym.errors import GreenhouseError, InvalidValueError, NoEpisodeError, UnknownKeywordError
from greenhouse_gym.geometry import Sphere, arrays_of
from greenhouse_gym.learning import DevicePpoSettings, PpoSettings, SacSettings
from greenhouse_gym.motion.distance_field import obstacle_field
from greenhouse_gym.scene import SceneBank

WRONG = [
    {"capacity": "a"}, {"capacity": 0}, {"capacity": -3}, {"capacity": 10**9}, {"capacity": True}, {"capacity": 2.5},
    {"randomization": None}, {"randomization": 0.1}, {"difficulty": 3}, {"difficulty": None}, {"difficulty": [3]},
    {"difficulty": {"easy": "much"}}, {"bank": None}, {"bank": 3}, {"robot": None}, {"robot": 5}, {"split": 3},
    {"physics": None}, {"success_radius": 0}, {"success_radius": float("nan")}, {"success_radius": "wide"},
    {"step_limit": 0}, {"step_limit": 2.5}, {"rate": 0}, {"rate": 30}, {"rate": 1000}, {"rate": "fast"},
    {"settings": {"bank": "mini"}}, {"settings": 3},
]  # fmt: skip


@pytest.mark.parametrize("keywords", WRONG, ids=str)
def test_wrong_settings_are_refused_by_name(keywords: dict[str, object], bank: SceneBank) -> None:
    for make in (GreenhouseEnv, GreenhouseVectorEnv):
        with pytest.raises(GreenhouseError, match=next(iter(keywords)).replace("_", ".")):
            make(**{"bank": bank, **keywords})


@pytest.mark.parametrize("threads", [1.5, "all", -1, None])
def test_wrong_numbers_of_threads_are_refused(threads: object, bank: SceneBank) -> None:
    with pytest.raises(InvalidValueError, match="threads"):
        GreenhouseVectorEnv(2, bank=bank, threads=threads)


@pytest.mark.parametrize("options", ["made-up-0", 3, {"scene": 3}, {"scene": b"made-up-0"}, {"difficulty": 3}])
def test_wrong_reset_options_are_refused(options: object, bank: SceneBank) -> None:
    for env in (GreenhouseEnv(bank=bank), GreenhouseVectorEnv(2, bank=bank)):
        with pytest.raises(InvalidValueError):
            env.reset(options=options)


def test_nothing_is_told_of_an_episode_before_the_first(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, render_mode="rgb_array")
    for ask in (lambda: env.step(np.zeros(6)), env.render, env.model_and_data, lambda: env.scene):
        with pytest.raises(NoEpisodeError, match="reset"):
            ask()
    with pytest.raises(NoEpisodeError, match="reset"):
        GreenhouseVectorEnv(2, bank=bank).step(np.zeros((2, 6)))


def test_unknown_keywords_are_told_as_python_tells_them(bank: SceneBank) -> None:
    for make in (gymnasium.make, gymnasium.make_vec):
        # torchrl's GymEnv looks for these words
        with pytest.raises(UnknownKeywordError, match=r"got an unexpected keyword argument 'frameskip'.*Choices: bank"):
            make("TomatoReach-v0", bank=bank, frameskip=1)


def test_the_step_limit_is_told_and_can_be_cut(bank: SceneBank) -> None:
    make, make_vec = gymnasium.make, gymnasium.make_vec
    assert make("TomatoReach-v0", bank=bank).spec.max_episode_steps == 200
    assert make("TomatoReach-v0", bank=bank, step_limit=300).spec.max_episode_steps == 300
    assert make_vec("TomatoReach-v0", 2, bank=bank).spec.max_episode_steps == 200
    single, many = (f("TomatoReach-v0", bank=bank, max_episode_steps=5) for f in (make, make_vec))
    again = make(make("TomatoReach-v0", bank=bank, step_limit=5).spec)
    assert [env.spec.max_episode_steps for env in (single, many, again)] == [5, 5, 5]
    for env in (single, many, again):
        env.reset(seed=0)
        action = np.zeros(env.action_space.shape, dtype=np.float32)
        assert [bool(np.all(env.step(action)[3])) for _ in range(5)] == [False] * 4 + [True]
    with pytest.raises(InvalidValueError, match=r"max_episode_steps.*1 to 200"):
        make_vec("TomatoReach-v0", 2, bank=bank, max_episode_steps=201)


def test_the_success_radius_decides(bank: SceneBank) -> None:
    start = {"start": [0.3, -1.2, 1.6, -1.9, -0.4, 0.2]}
    seed, info = next(
        (seed, info)
        for seed in range(100)
        if (info := GreenhouseEnv(bank=bank).reset(seed=seed, options=start)[1])["distance"] < 0.5
        and not info["collision"]
    )
    wide = GreenhouseEnv(bank=bank, success_radius=info["distance"] + 0.05)
    assert not info["is_success"]
    assert wide.reset(seed=seed, options=start)[1]["is_success"]
    assert wide.step(np.zeros(6))[2]


@pytest.mark.parametrize("rate", [100, 50, 10, 4])
def test_joints_move_as_far_per_second_at_every_rate(rate: int) -> None:
    placed = scene_of([Tomato(Sphere([0.0, 5.0, 1.0], 0.03), truss=0)])
    ends = []
    for chosen in (20, rate):
        env = make_for(placed, rate=chosen, step_limit=1000, action="joint")
        assert env.metadata["render_fps"] == chosen
        start = env.reset(options={"scene": placed})[0][:6]
        action = np.array([0.5, 0, 0, 0, 0, 0])
        seen = [env.step(action) for _ in range(chosen)]  # a second
        assert not any(info["speed_limited"] or info["position_limited"] for *_, info in seen)
        ends.append(seen[-1][0][:6] - start)
    np.testing.assert_allclose(ends[1], ends[0], atol=0.01)
    assert ends[0][0] == pytest.approx(0.8, abs=0.06)


@pytest.mark.parametrize("rate", [100, 10])
def test_vector_equals_single_at_other_rates(rate: int, bank: SceneBank) -> None:
    drift = np.random.default_rng(2).uniform(-1, 1, (3, 6))
    drift[:, 1] = 0.8
    compare_with_singles(3, 150 if rate == 100 else 30, lambda step: drift, "SameStep", bank=bank, rate=rate)


def test_a_huge_radius_beside_a_small_one_gives_numbers() -> None:
    placed = scene_of([Tomato(Sphere([0.9, 0.0, 1.2], 0.03), truss=0), Tomato(Sphere([0.9, 0.3, 1.2], 90.0), truss=1)])
    env = make_for(placed)
    observation, info = env.reset(options={"scene": placed, "target": 0})
    assert env.observation_space.contains(observation)
    assert np.isfinite(info["clearance"])
    for radius in (3e5, 1e30):  # no scene may hold them, but a field of numbers stays one
        field = obstacle_field(arrays_of([Sphere([0.9, 0.0, 0.0], radius), Sphere([0.9, 0.3, 0.0], radius)]), 1)
        assert np.isfinite(field["distance"]).all()
        assert np.isfinite(field["otherwise"]).all()


def test_too_many_tomatoes_are_refused_before_they_take_room() -> None:
    tomatoes = [Tomato(Sphere([0.9, 0.0, 1.2], 0.03), truss=0)]
    many = scene_of(tomatoes).model_copy(update={"tomatoes": tuple(tomatoes * 300_000)})
    with pytest.raises(InvalidValueError, match="300000 obstacles, more than the 600 allowed"):
        make_for(scene_of(tomatoes)).reset(options={"scene": many, "target": 0})


def test_one_default_action_everywhere_which_recordings_name(bank: SceneBank) -> None:
    default = EnvSettings().action
    trainings = (PpoSettings, DevicePpoSettings, SacSettings)
    assert {settings().action for settings in trainings} == {default} == {"tip_velocity"}
    env = gymnasium.make("TomatoReach-v0", bank=bank)
    for spec in (env.spec, EnvSettings(bank=bank).spec()):
        assert spec is not None
        assert json.loads(spec.to_json())["kwargs"]["action"] == default


def test_settings_are_frozen_and_compare_by_value() -> None:
    assert EnvSettings(rate=10) == EnvSettings(rate=10) != EnvSettings()
    with pytest.raises(AttributeError):
        EnvSettings().rate = 10  # type: ignore[misc]
