"""Rewards, observations and actions from outside: the examples, and the errors of wrong ones."""

from __future__ import annotations

import importlib.util
import inspect
import runpy
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from test_vector import compare_with_singles, equal

from greenhouse_gym.envs import (
    DenseReward,
    DepthCamera,
    EnvSettings,
    GreenhouseEnv,
    GreenhouseVectorEnv,
    PathReward,
    RgbObservation,
    SparseReward,
)
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.motion.distance_field import MAX_DISTANCE
from greenhouse_gym.scene import SceneBank

EXAMPLES = Path(__file__).parents[2] / "examples"
OWN = {
    "own_reward": ("reward", "careful"),
    "own_observation": ("observation", "Feelers"),
    "own_distances": ("observation", "Ahead"),
    "own_action": ("action", "TwoJoints"),
}


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def keyword(name: str) -> dict[str, Any]:
    what, thing = OWN[name]
    own = getattr(example(name), thing)
    return {what: own() if name in ("own_action", "own_distances") else own}


@pytest.mark.parametrize("name", OWN)
def test_examples_are_short_and_run_as_they_are(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    own = getattr(example(name), OWN[name][1])
    assert len(inspect.getsource(own).splitlines()) <= 20
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert capsys.readouterr().out


@pytest.mark.parametrize("name", OWN)
def test_own_objects_pass_the_checkers_and_twins_agree(name: str, bank: SceneBank) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make("TomatoReach-v0", bank=bank, **keyword(name))
        check_env(env.unwrapped, skip_render_check=True)
    actions = [env.action_space.sample() for _ in range(20)]
    seen = []
    for _ in range(2):
        twin = GreenhouseEnv(bank=bank, **keyword(name))
        seen.append([twin.reset(seed=3), *map(twin.step, actions)])
    assert all(_same(a, b) for a, b in zip(*seen, strict=True))


def _same(a: tuple[Any, ...], b: tuple[Any, ...]) -> bool:
    return all(equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("name", OWN)
def test_own_objects_give_the_same_in_vector_and_single(name: str, bank: SceneBank) -> None:
    random = np.random.default_rng(1)
    size = 2 if name == "own_action" else 6
    drift = random.uniform(0, 1, (3, size))

    def actions(step: int) -> np.ndarray:
        return drift + random.uniform(-0.3, 0.3, (3, size))

    assert compare_with_singles(3, 60, actions, "SameStep", bank=bank, **keyword(name)) > 0


def test_distances_at_points_are_those_of_each_simulation_alone(bank: SceneBank) -> None:
    """Also after an episode of some of the simulations began again; wrong points raise an error."""
    env, states = GreenhouseVectorEnv(3, bank=bank, autoreset_mode="SameStep"), []
    env.reset(seed=0)
    for i in (0, 1, 2):
        env.reset(seed=i, options={"reset_mask": np.arange(3) == i})
        states.append(env.simulation.state)
    state = states[-1]
    tip = state.tip[:, None]
    distance, direction = state.distances_at(tip + 0.4 * np.eye(3)[0])
    for i in range(3):
        alone = state.select(np.array([i])).distances_at(tip[i : i + 1] + 0.4 * np.eye(3)[0])
        assert np.array_equal(alone[0][0], distance[i])
        assert np.array_equal(alone[1][0], direction[i])
    assert (distance <= MAX_DISTANCE).all()
    for points in (tip[:2], state.tip, np.full((3, 1, 3), np.nan)):
        with pytest.raises(InvalidValueError, match="points must be finite numbers of shape"):
            state.distances_at(points)


def test_rgb_and_rgbd_give_the_same_in_vector_and_single(bank: SceneBank) -> None:
    random = np.random.default_rng(1)
    for mode, kind in (("NextStep", "rgb"), ("SameStep", "rgbd")):
        keywords = {"bank": bank, "observation": kind}
        compare_with_singles(2, 8, lambda step: random.uniform(-1, 1, (2, 6)), mode, **keywords)


def test_color_images_show_the_plants_and_the_arm(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, observation=RgbObservation(DepthCamera("mast", 64, 48), depth=True))
    seen, _ = env.reset(seed=0)
    assert seen["rgb"].shape == (3, 48, 64)
    assert seen["rgb"].dtype == np.uint8
    near = seen["depth"][0] > 0
    assert 0.05 < near.mean() < 1.0
    assert seen["rgb"].std() > 20
    r, g, b = seen["rgb"].astype(int)
    assert ((r > 2 * g) & (r > 2 * b) & near).any()  # ripe tomatoes
    before = seen["rgb"]
    for _ in range(5):
        seen, *_ = env.step(np.full(6, 0.5))
    assert not np.array_equal(seen["rgb"], before)  # the arm moves through the picture


def test_rewards_with_other_figures(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, reward=DenseReward(success=5.0, time=-0.5, effort=0.0))
    env.reset(seed=0)
    terms = env.step(np.ones(6))[4]["reward_terms"]
    assert terms["time"] == -0.5
    assert terms["effort"] == 0.0
    assert GreenhouseEnv(bank=bank, reward=SparseReward(collision=-3.0)).simulation.reward_terms.collision == -3.0
    with pytest.raises(InvalidValueError, match=r"DenseReward\.progress.*nan"):
        DenseReward(progress=float("nan"))


def test_settings_and_keywords_say_the_same(bank: SceneBank) -> None:
    settings = EnvSettings(bank=bank, reward="sparse", step_limit=7, success_radius=0.05)
    one = gymnasium.make("TomatoReach-v0", settings=settings)
    two = gymnasium.make("TomatoReach-v0", bank=bank, reward="sparse", step_limit=7, success_radius=0.05)
    assert one.unwrapped.settings == two.unwrapped.settings
    assert gymnasium.make("TomatoReach-v0", settings=settings, step_limit=9).unwrapped.settings.step_limit == 9
    one.reset(seed=0)
    assert [one.step(np.zeros(6))[3] for _ in range(7)] == [False] * 6 + [True]


class Constant:
    """Returns a fixed value."""

    def __init__(self, given: Any, space: spaces.Space[Any] | None = None):
        self.given, self.space = given, space or spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __call__(self, *arguments: Any) -> Any:
        return self.given(arguments[0]) if callable(self.given) else self.given


def rows(value: Any, dtype: Any = np.float32, size: int = 2) -> Callable[[Any], Any]:
    return lambda state: np.full((len(state.joints), size), value, dtype)


PAIR = spaces.Dict({"a": spaces.Box(0, 1, (2,), np.float32), "b": spaces.Box(0, 255, (3,), np.uint8)})


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"reward": Constant({"pay": np.array([np.nan])})}, r"reward Constant, term 'pay'.*finite.*nan"),
        ({"reward": Constant({"pay": np.zeros(3)})}, r"reward Constant, term 'pay'.*\(1,\)"),
        ({"reward": Constant({"pay": 1.0})}, r"term 'pay'"),
        ({"reward": Constant({"pay": "much"})}, r"term 'pay'"),
        ({"reward": Constant(np.zeros(1))}, r"reward Constant must return a dict"),
        ({"reward": Constant({})}, r"reward Constant must return a dict"),
        ({"observation": Constant(rows(2.0))}, r"observation Constant must lie within.*-1.0 to 1.0 at \[0\], got 2.0"),
        ({"observation": Constant(rows(np.nan))}, r"observation Constant must lie within.*nan"),
        ({"observation": Constant(rows(0.5, np.float64))}, r"observation Constant.*float32, got float64"),
        ({"observation": Constant(rows(0.5, size=3))}, r"observation Constant.*\(1, 2\)"),
        ({"observation": Constant(rows(0.5), PAIR)}, r"observation Constant must return a dict with 'a', 'b'"),
        (
            {"observation": Constant(lambda s: {"a": rows(0.5)(s), "b": rows(7, size=3)(s)}, PAIR)},
            r"observation Constant\['b'\].*uint8, got float32",
        ),
        ({"action": Constant(np.zeros((1, 5)))}, r"action Constant.*\(1, 6\)"),
        ({"action": Constant(np.full((1, 6), np.inf))}, r"action Constant.*finite"),
    ],
)  # fmt: skip
def test_what_own_objects_do_wrong_is_reported_by_name(bank: SceneBank, keywords: dict[str, Any], message: str) -> None:
    env = GreenhouseEnv(bank=bank, **keywords)
    with pytest.raises(InvalidValueError, match=message):  # noqa: PT012 - whichever of the two looks first
        env.reset(seed=0)
        env.step(np.zeros(env.action_space.shape))


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"reward": 3}, "reward must be one of 'sparse', 'dense', 'path' or a function"),
        ({"reward": DenseReward}, "reward must be"),
        ({"reward": None}, "reward must be"),
        ({"reward": "path", "observation": "goal"}, "goals in hindsight"),
        ({"reward": PathReward(progress=1.0), "observation": "goal_roadmap"}, "goals in hindsight"),
        ({"observation": 3}, "observation must be a name"),
        ({"observation": lambda robot: 3}, "space"),
        ({"observation": lambda: 3}, "function of Robot that makes one"),
        ({"observation": type("Fixed", (), {"space": PAIR, "__call__": len})}, "observation Fixed must be an object"),
        ({"action": lambda robot: 3}, "function of Robot and float that makes one"),
        ({"observation": Constant(0, spaces.Discrete(3))}, "observation Constant.*boxes"),
        ({"action": None}, "action must be a name"),
        ({"action": Constant(0, spaces.Discrete(3))}, "action Constant.*Box"),
    ],
)  # fmt: skip
def test_what_is_no_reward_observation_or_action_is_refused(
    bank: SceneBank, keywords: dict[str, Any], message: str
) -> None:
    for make in (GreenhouseEnv, GreenhouseVectorEnv):
        with pytest.raises(InvalidValueError, match=message):
            make(bank=bank, **keywords)
    with pytest.raises(UnknownNameError, match="rgbd"):
        GreenhouseEnv(bank=bank, observation="rgdb")


def test_a_reward_that_reads_states_has_no_value_in_hindsight(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, observation="goal", **keyword("own_reward"))
    seen, _ = env.reset(seed=0)
    *_, info = env.step(np.zeros(6))
    with pytest.raises(InvalidValueError, match="in hindsight"):
        env.compute_reward(seen["achieved_goal"], seen["desired_goal"], info)
    paid = GreenhouseEnv(bank=bank, observation="goal", reward=lambda step: {"near": 1.0 / (0.1 + step.after)})
    paid.reset(seed=0)
    seen, reward, *_, info = paid.step(np.zeros(6))
    assert paid.compute_reward(seen["achieved_goal"], seen["desired_goal"], info) == reward
