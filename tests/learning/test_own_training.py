"""Trainings with a user's own observation, action, reward and task, and with one scene and target."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

pytest.importorskip("stable_baselines3")

from greenhouse_gym.agents import make_agent
from greenhouse_gym.common.settings_files import as_toml, resolve
from greenhouse_gym.envs import DenseReward, DepthCamera, DepthObservation, EnvSettings, State, make_env
from greenhouse_gym.errors import FileFormatError, GreenhouseError, InvalidValueError, UnknownNameError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.learning import BcThenPpoSettings, PpoSettings, SacSettings, train_ppo, train_sac
from greenhouse_gym.learning.imitation import ImitationSettings
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import SceneBank

OWN = """
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from helpers_of_own_code import FACTOR
from greenhouse_gym.envs import Outcome, Task


@dataclass(frozen=True)
class Near:
    scale: float = FACTOR

    def __call__(self, step):
        return {"near": -self.scale * step.after}


class Parts:
    space = spaces.Dict({"joints": spaces.Box(-9, 9, (6,), np.float32), "goal": spaces.Box(-9, 9, (3,), np.float32)})

    def __call__(self, state):
        goal = np.clip(state.target, -9, 9)
        return {"joints": state.joints.astype(np.float32), "goal": goal.astype(np.float32)}


class Shoulder:
    space = spaces.Box(-1, 1, (1,), np.float32)

    def __call__(self, action, state, motion):
        change = np.zeros_like(state.joints)
        change[:, :1] = 0.05 * action
        return change


class Stay(Task):
    def evaluate(self, state):
        done = np.zeros(len(state.joints), dtype=bool)
        return Outcome(np.linalg.norm(state.target - state.grasp, axis=1), done, done)


def broken(robot):
    raise ZeroDivisionError("no space")
"""


@dataclass(frozen=True)
class Joints:
    """Observation with a parameter; its name is at the top of a module."""

    limit: float = 7.0

    @property
    def space(self) -> spaces.Box:
        return spaces.Box(-self.limit, self.limit, (6,), np.float32)

    def __call__(self, state: State) -> np.ndarray:
        return np.clip(state.joints, -self.limit, self.limit).astype(np.float32)


class OfRobot(Joints):
    """Observation made from the arm."""

    def __init__(self, robot: Robot):
        super().__init__(float(len(robot.joints)))


@pytest.fixture
def settings(bank: SceneBank) -> PpoSettings:
    return PpoSettings(
        bank=str(bank.path), observation="state", reward="dense", total_steps=16, num_envs=2, rollout_steps=8,
        batch_size=16, epochs=1, hidden=(8,), threads=1,
    )  # fmt: skip


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A file of own code that imports a module next to it, by a path relative to the working folder."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "own.py").write_text(OWN)
    (tmp_path / "code" / "helpers_of_own_code.py").write_text("FACTOR = 3.0\n")
    monkeypatch.chdir(tmp_path)
    return "code/own.py"


def test_everything_own_is_trained_and_evaluated_from_another_folder(
    settings: PpoSettings, own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "settings.toml"
    file.write_text(f'task = "{own}:Stay"\nreward = {{ class = "{own}:Near", scale = 2.0 }}\n')
    assigned = resolve(settings, file, [f"observation={own}:Parts", f"action={own}:Shoulder"])
    models: list[Any] = []
    path = train_ppo(assigned, tmp_path / "run", prepare=models.append)
    assert type(models[0].policy).__name__ == "MultiInputActorCriticPolicy"
    assert path.name == "checkpoint.safetensors"
    monkeypatch.chdir("/")
    for name in (str(path), str(path.parent)):
        agent = make_agent(name)
        assert set(agent.env_options) == {"robot", "observation", "action", "task"}
        result = evaluate(agent, episodes=1, bank=settings.bank, step_limit=3)
        assert result.records[0].steps == 3
    longer = resolve(replace(assigned, total_steps=32), assignments=[f"reward.scale={2.0}"])
    train_ppo(longer, path.parent, resume=True)
    with pytest.raises(InvalidValueError, match="reward"):
        train_ppo(resolve(longer, assignments=["reward.scale=1.0"]), path.parent, resume=True)
    assert resolve(settings, None, as_toml(assigned).splitlines()) == assigned


@pytest.mark.parametrize(
    ("changed", "stored"),
    [
        ({"observation": Joints(6.5)}, {"class": "{here}:Joints", "limit": 6.5}),
        ({"observation": OfRobot}, "{here}:OfRobot"),
        ({"reward": DenseReward(progress=2.0)}, None),
        ({"reward": lambda step: {"near": -step.after}}, None),
    ],
    ids=["instance", "class", "built-in", "lambda"],
)
def test_objects_are_trained_and_a_policy_file_names_them(
    settings: PpoSettings, tmp_path: Path, changed: dict[str, Any], stored: Any
) -> None:
    path = train_ppo(replace(settings, **changed), tmp_path / "run")
    options = json.loads(path.read_text())["env_options"]
    if stored is not None:
        here = options["observation"]["class"] if isinstance(stored, dict) else options["observation"]
        module = here.split(":")[0]
        assert module in (__name__, str(Path(__file__).resolve()))
        assert json.loads(json.dumps(stored).replace("{here}", module)) == options["observation"]
    agent = make_agent(str(path.parent))
    assert evaluate(agent, episodes=1, bank=settings.bank, step_limit=2).records[0].steps == 2


def test_images_train_and_come_back(settings: PpoSettings, tmp_path: Path) -> None:
    small = DepthObservation(camera=DepthCamera(width=8, height=6))
    path = train_ppo(replace(settings, observation=small), tmp_path / "run")
    agent = make_agent(str(path))
    assert make_env(bank=settings.bank, **agent.env_options).observation_space["depth"].shape == (1, 6, 8)
    assert evaluate(agent, episodes=1, bank=settings.bank, step_limit=2).records[0].steps == 2


@pytest.mark.parametrize(
    ("choice", "error", "message"),
    [
        ("{own}:Missing", UnknownNameError, "Parts"),
        ("nowhere.py:Parts", FileFormatError, "there is no such file"),
        ("no_such_module:Parts", InvalidValueError, "no_such_module"),
        ("{own}:broken", InvalidValueError, "ZeroDivisionError: no space"),
        ({"scale": 2.0}, InvalidValueError, "class"),
        ({"class": "nothing"}, InvalidValueError, "expected"),
        ({"class": "{own}:Parts", "size": 3}, InvalidValueError, "size"),
        (3, InvalidValueError, "observation"),
        (lambda robot: None, InvalidValueError, "name"),
    ],
)
def test_wrong_choices_are_told_before_anything_is_written(
    settings: PpoSettings, own: str, tmp_path: Path, choice: Any, error: type[GreenhouseError], message: str
) -> None:
    if not callable(choice) and not isinstance(choice, int):
        choice = json.loads(json.dumps(choice).replace("{own}", own))
    with pytest.raises(error, match=message):
        train_ppo(replace(settings, observation=choice), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_one_target_is_trained_again_and_again(settings: PpoSettings, bank: SceneBank, tmp_path: Path) -> None:
    name = bank.names("test")[0]
    drawn: list[Any] = []

    def note(model: Any) -> None:
        simulation = model.get_env().get_attr("simulation")[0]
        drawn.append([simulation.sampler.draw(np.random.default_rng(k)) for k in range(5)])

    train_ppo(resolve(settings, assignments=[f"scene={name}", "target=4"]), tmp_path / "run", prepare=note)
    assert {(episode.scene.name, episode.targets) for episode in drawn[0]} == {(name, (4,))}
    env = make_env(bank=bank, scene=name, target=4)
    assert all(env.reset(seed=seed)[1]["target"] == 4 for seed in range(3))
    assert env.reset(options={"target": 2})[1]["target"] == 2
    other = env.reset(options={"scene": bank.names("train")[0]})[1]
    assert other["scene"] == bank.names("train")[0]
    for wrong in ({"target": 4}, {"scene": name, "target": 10**6}, {"scene": "nowhere"}, {"scene": 3}):
        with pytest.raises(GreenhouseError, match=r"scene|target"):
            make_env(bank=bank, **wrong)  # type: ignore[arg-type]
    assert EnvSettings(bank=bank, scene=bank.scene(name)).keywords()["scene"] == name


def test_hindsight_needs_goals(bank: SceneBank, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="goals"):
        train_sac(SacSettings(bank=str(bank.path), observation="depth"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "changed",
    [
        {"seed": 2**32}, {"seed": -1}, {"seed": 1.5}, {"batch_size": 1}, {"rollout_steps": 0}, {"epochs": 0},
        {"learning_rate": float("nan")}, {"learning_rate": "fast"}, {"learning_rate": 0.0}, {"discount": 1.5},
        {"hidden": (-3,)}, {"hidden": 3}, {"hidden": ("8",)}, {"hidden": (10**9,)}, {"num_envs": 0},
        {"num_envs": 2**70}, {"total_steps": 1.5}, {"log_std": float("inf")}, {"clip_range": 0}, {"activation": "none"},
        {"threads": -1}, {"validation_episodes": True}, {"difficulty": 3}, {"target": "1"},
        {"num_envs": 1, "rollout_steps": 1},
    ],
    ids=str,
)  # fmt: skip
def test_settings_out_of_their_bounds_are_named(changed: dict[str, Any]) -> None:
    name = list(changed)[-1]
    with pytest.raises(GreenhouseError, match=name):
        PpoSettings(**changed)
    if hasattr(SacSettings, name) and name != "batch_size":
        with pytest.raises(InvalidValueError, match=name):
            SacSettings(**changed)


def test_settings_of_imitation_and_seconds_are_checked(settings: PpoSettings, tmp_path: Path) -> None:
    for wrong in ({"steps": -1}, {"batch_size": 0}, {"learning_rate": float("nan")}, {"noise": "much"}):
        with pytest.raises(InvalidValueError, match=next(iter(wrong))):
            ImitationSettings(**wrong)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="variations"):
        BcThenPpoSettings(variations=-1)
    for seconds in ({"time_limit": float("nan")}, {"time_limit": "1"}, {"checkpoint_seconds": -1}):
        with pytest.raises(InvalidValueError, match="seconds"):
            train_ppo(settings, tmp_path / "run", **seconds)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="total_steps"):
        train_ppo(replace(settings, total_steps=0), tmp_path / "run")
    with pytest.raises(InvalidValueError, match="total_steps"):
        train_ppo(replace(settings, total_steps=-5), tmp_path / "run", prepare=lambda model: None)


def test_a_trained_model_goes_to_other_processes_by_its_folder(settings: PpoSettings, tmp_path: Path) -> None:
    train_ppo(replace(settings, observation="goal", reward="dense", log_std=-1.0), tmp_path / "goals")
    assert make_agent(str(tmp_path / "goals")).name == "goals"
    small = DepthObservation(camera=DepthCamera(width=8, height=6))
    train_ppo(replace(settings, observation=small), tmp_path / "depth")
    agent = make_agent(str(tmp_path / "depth" / "checkpoint.safetensors"))
    again = pickle.loads(pickle.dumps(agent))
    assert (again.name, again.env_options) == (agent.name, agent.env_options) == ("depth", agent.env_options)
    env = make_env(bank=settings.bank, **agent.env_options)
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(agent.act(observation), again.act(observation))
