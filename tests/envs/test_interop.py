"""Environments as other libraries take them: pickles, specifications, checks, infos, images."""

from __future__ import annotations

import json
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from test_vector import equal

from greenhouse_gym.envs import DenseReward, DepthCamera, DepthObservation, GreenhouseEnv, GreenhouseVectorEnv
from greenhouse_gym.errors import GreenhouseError, InvalidValueError
from greenhouse_gym.rendering.renderer import Viewpoint
from greenhouse_gym.scene import SceneBank


@pytest.mark.parametrize("keywords", [{}, {"observation": "goal", "reward": DenseReward(progress=1.0)}], ids=str)
def test_a_pickled_environment_plays_the_same_episodes(bank: SceneBank, keywords: dict[str, Any]) -> None:
    env = gymnasium.make("TomatoReach-v0", bank=bank, scene=bank[0], **keywords)
    env.reset(seed=3)
    content = pickle.dumps(env)
    assert len(content) < 5000, "scenes by name"
    again = pickle.loads(content)
    assert again.spec == env.spec
    action = np.full(6, 0.1, dtype=np.float32)
    for one, other in ((again.reset(), env.reset()), (again.step(action), env.step(action))):
        assert all(equal(a, b) for a, b in zip(one, other, strict=True))
    venv = GreenhouseVectorEnv(2, bank=bank, autoreset_mode="SameStep", **keywords)
    twin = pickle.loads(pickle.dumps(venv))
    assert twin.autoreset_mode == AutoresetMode.SAME_STEP
    assert equal(twin.reset(seed=1)[0], venv.reset(seed=1)[0])


def test_a_specification_is_json_and_makes_the_environment_again(bank: SceneBank) -> None:
    own = DepthObservation(camera=DepthCamera(width=16, height=12))
    env = gymnasium.make("TomatoReach-v0", bank=bank, observation=own, reward=DenseReward(time=-0.1), start="folded")
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.observation_space == env.observation_space
    assert again.unwrapped.simulation.reward_terms == DenseReward(time=-0.1)
    assert "bank" in repr(again.unwrapped)
    assert len(repr(env.unwrapped)) < 500
    assert json.loads(env.spec.to_json())["kwargs"]["bank"] == str(bank.path)


def test_gymnasiums_check_passes_without_a_display(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    env = gymnasium.make("TomatoReach-v0", bank=bank, width=32, height=24, render_mode="depth_array")
    assert "human" not in env.metadata["render_modes"]
    check_env(env.unwrapped)


@pytest.mark.parametrize("camera", ["behind", "top", Viewpoint((-1.0, -1.0, 1.5), (0.5, 0.0, 1.2))], ids=str)
def test_size_and_camera_of_images(bank: SceneBank, camera: Any) -> None:
    plain = GreenhouseEnv(bank=bank, render_mode="depth_array", width=32, height=24)
    env = GreenhouseEnv(bank=bank, render_mode="depth_array", width=32, height=24, camera=camera)
    plain.reset(seed=0)
    env.reset(seed=0)
    assert env.render().shape == (24, 32)
    assert not np.array_equal(env.render(), plain.render())
    venv = GreenhouseVectorEnv(1, bank=bank, render_mode="depth_array", width=32, height=24, camera=camera)
    venv.reset(seed=0)
    assert np.array_equal(venv.render()[0], env.render())


def test_wrong_sizes_and_cameras_are_named(bank: SceneBank) -> None:
    straight_down = Viewpoint((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    for wrong in ({"width": 0}, {"width": 2.5}, {"height": 10**9}, {"height": True}, {"camera": "moon"}, {"camera": 3},
                  {"camera": straight_down}):  # fmt: skip
        with pytest.raises(GreenhouseError, match=next(iter(wrong))):
            GreenhouseEnv(bank=bank, render_mode="rgb_array", **wrong)


def values(infos: dict[str, Any]) -> dict[str, Any]:
    """Infos as plain values: Gymnasium keeps NumPy's flags as objects."""
    plain = {}
    for key, value in infos.items():
        if isinstance(value, dict):
            plain[key] = values(value)
        elif key != "final_obs":
            flags = value.dtype == object and any(isinstance(each, np.bool_) for each in value)
            plain[key] = [bool(each) for each in value] if flags else value.tolist()
    return plain


@pytest.mark.parametrize("observation", ["state", "goal"])
@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
def test_infos_are_those_of_gymnasiums_vector_environment(
    bank: SceneBank, mode: AutoresetMode, observation: str
) -> None:
    keywords: dict[str, Any] = {"bank": bank, "observation": observation, "step_limit": 3}
    native = GreenhouseVectorEnv(3, autoreset_mode=mode, **keywords)
    sync = SyncVectorEnv([lambda: GreenhouseEnv(**keywords)] * 3, autoreset_mode=mode)
    assert values(native.reset(seed=5)[1]) == values(sync.reset(seed=5)[1])
    rng = np.random.default_rng(0)
    for step in range(9):
        actions = rng.uniform(-1, 1, (3, 6)).astype(np.float32)
        result, expected = native.step(actions), sync.step(actions)
        assert values(result[4]) == values(expected[4])
        mask = result[2] | result[3] if mode == AutoresetMode.DISABLED else np.array([step == 1, False, False])
        if mask.any():
            reset, other = (env.reset(options={"reset_mask": mask.copy()})[1] for env in (native, sync))
            assert values(reset) == values(other)


def test_infos_of_numbers_have_one_level_and_a_type(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, infos="numbers")
    for info in (env.reset(seed=0)[1], env.step(np.zeros(6))[4]):
        assert all(isinstance(value, np.generic) for value in info.values())
        assert isinstance(info["is_success"], np.bool_)
    assert {"contacts.leaf", "reward_terms.progress", "distance"} <= info.keys()
    assert "scene" not in info
    venv = GreenhouseVectorEnv(2, bank=bank, infos="numbers", autoreset_mode="SameStep", step_limit=2)
    venv.reset(seed=0)
    for _ in range(4):
        infos = venv.step(np.zeros((2, 6)))[4]
        final = infos.pop("final_info", {})
        for name, array in (*infos.items(), *final.items()):
            assert array.shape[0] == 2, name
            assert array.dtype != object or name == "final_obs"
    with pytest.raises(GreenhouseError, match="infos"):
        GreenhouseEnv(bank=bank, infos="some")


@pytest.mark.slow
def test_processes_of_gymnasium_get_a_pickled_environment(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, infos="numbers", step_limit=2)
    venv = AsyncVectorEnv([lambda: env] * 2)
    assert venv.reset(seed=1)[0].shape == (2, *env.observation_space.shape)
    venv.close()


@pytest.mark.parametrize(
    "action",
    [[1j] * 6, ["0.1"] * 6, [None] * 6, [10**400] * 6, {"a": 1}, None, [object()] * 6],
    ids=["complex", "text", "nothing", "huge", "mapping", "none", "objects"],
)
def test_actions_that_are_no_real_numbers_are_refused(bank: SceneBank, action: Any) -> None:
    env = GreenhouseEnv(bank=bank)
    env.reset(seed=0)
    with pytest.raises(InvalidValueError, match="action"):
        env.step(action)


@pytest.mark.parametrize(
    "wrong",
    [{"success_radius": 2**70}, {"success_radius": 10**400}, {"success_radius": 1j}, {"rate": 2**1100},
     {"start": ["1"] * 6}],
    ids=["large", "huge", "complex", "rate", "text"],
)  # fmt: skip
def test_settings_that_no_float_holds_are_refused(bank: SceneBank, wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(wrong))):
        GreenhouseEnv(bank=bank, **wrong)
