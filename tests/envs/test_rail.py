"""An arm on a rail along the row: its file, its cart and crate, harvests along a row, and errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.harvest.harvester import OracleHarvester
from greenhouse_gym.agents.harvest.picking import pointing_down
from greenhouse_gym.agents.harvest.rail import drive, parked_at, stops_of
from greenhouse_gym.envs import make_env
from greenhouse_gym.envs.environment import GreenhouseEnv
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.motion.collision import MARGIN, CollisionChecker, set_margin
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.robots import ROBOTS, get_robot, mount_on_rail
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.scene import compile_scene
from greenhouse_gym.scene.obstacles import Surroundings

OPTIONS: dict[str, Any] = {
    "bank": "mini", "task": "harvest", "size": "row", "plants": "compliant", "physics": "truth",
    "scene": "helios-cherry-2006-w06-02", "action": "joint",
}  # fmt: skip


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return mount_on_rail("ur5e", tmp_path_factory.mktemp("arm") / "ur5e-rail.xml")


@pytest.mark.parametrize("name", ROBOTS)
def test_an_arm_keeps_everything_and_gets_a_first_joint(name: str, tmp_path: Path) -> None:
    plain, railed = get_robot(name), get_robot(mount_on_rail(name, tmp_path / "railed.xml", 0.4))
    assert railed.on_rail
    assert not plain.on_rail
    assert railed.joints == ("rail", *plain.joints)
    assert (railed.lower[0], railed.upper[0], railed.start[0]) == (-0.4, 0.4, 0.0)
    np.testing.assert_allclose(railed.start[1:], plain.start)
    np.testing.assert_allclose(railed.velocity_limits[1:], plain.velocity_limits)
    assert railed.shoulder_height == pytest.approx(plain.shoulder_height)
    assert stops_of(railed) == [-0.4, 0.0, 0.4]
    assert stops_of(plain) == [0.0]
    parked = parked_at(railed, 0.4)
    assert (parked.lower[0], parked.upper[0]) == (0.398, 0.4)


def parts(env: GreenhouseEnv) -> np.ndarray:
    """Return the positions of crate, column, shoulder and rail."""
    _, data = env.model_and_data()
    return np.array(
        [data.body("crate").xpos, data.geom("column").xpos, data.body("shoulder").xpos, data.geom("cart").xpos]
    )


def test_cart_arm_and_crate_drive_together_along_the_row(arm: Path) -> None:
    env = make_env(**OPTIONS, robot=arm)
    first, _ = env.reset(seed=0)
    before = parts(env)
    problem = Problem.of(env.simulation, 0, 0, knows_truth=True)
    for action in drive(problem, "RRTConnect", 0.5):
        last, *_, info = env.step(action)
    np.testing.assert_allclose(parts(env) - before, [[0.0, 0.5, 0.0]] * 3 + [[0.0, 0.0, 0.0]], atol=1e-3)
    assert not info["collision"]
    assert info["steps"] * env.simulation.interval == pytest.approx(0.5 / 0.25, abs=1.2)
    features = {name: slice(21 + 3 * k, 24 + 3 * k) for k, name in enumerate(("tip", "axis"))}
    np.testing.assert_allclose(last[features["tip"]] - first[features["tip"]], [0.0, 0.5, 0.0], atol=2e-3)
    np.testing.assert_allclose(last[features["axis"]], first[features["axis"]], atol=2e-3)


@pytest.mark.parametrize("stop", [-0.5, -0.1, 0.0, 0.5])
def test_no_stop_is_too_near_to_the_rail_for_a_plan(arm: Path, stop: float) -> None:
    for robot in (get_robot(arm), parked_at(get_robot(arm), stop)):
        model = compile_scene(Surroundings(name="bare"), robot).model
        set_margin(model, np.flatnonzero(model.geom_bodyid == 0), MARGIN)
        checker = CollisionChecker(model, arm_reaches(robot))
        start = robot.start.copy()
        start[0] = stop
        assert checker.is_free(start)


def test_a_parked_arm_finds_as_many_configurations_as_one_without_a_rail(arm: Path) -> None:
    found = []
    for robot in (get_robot("ur5e"), parked_at(get_robot(arm), 0.0), parked_at(get_robot(arm), 0.5)):
        compiled = compile_scene(Surroundings(name="bare"), robot)
        chain, along = tool_chain(compiled.model, compiled.tip_site), 0.5 * (robot.lower[0] > 0.4)
        point = np.array([-0.05, 0.45 + along, 0.75])
        goals = pointing_down(chain, robot, robot.start, point, seed=0)
        state = tool_state(chain, goals, 0.0)
        assert np.linalg.norm(state.point - point, axis=1).max() < 2e-3
        assert ((goals >= robot.lower) & (goals <= robot.upper)).all()
        found.append(len(goals))
    assert found[0] >= 40
    assert min(found[1:]) > 0.8 * found[0]


@pytest.mark.slow
def test_an_oracle_harvests_along_a_row(arm: Path) -> None:
    env = make_env(**OPTIONS, robot=arm)
    observation, info = env.reset(seed=0)
    agent, over, places = OracleHarvester(), False, set()
    agent.reset(Problem.of(env.simulation, 0, 0, knows_truth=True))
    while not over:
        picked = info["crated"]
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        over = terminated or truncated
        if info["crated"] > picked:
            places.add(round(float(env.simulation.command[0, 0]), 2))
    assert info["is_success"]
    assert len(places) > 1, "fruit at several stops"
    assert (info["dropped"], info["damaged"]) == (0, 0)


def test_a_row_needs_a_rail() -> None:
    with pytest.raises(InvalidValueError, match=r"robot 'ur5e' has none: greenhouse_gym\.robots\.mount_on_rail writes"):
        make_env(**OPTIONS).reset(seed=0)


def test_a_rail_beyond_the_row_is_refused(tmp_path: Path) -> None:
    env = make_env(**OPTIONS, robot=mount_on_rail("ur5e", tmp_path / "long.xml", 4.0))
    with pytest.raises(InvalidValueError, match=r"from -4\.00 to 4\.00 m, beyond the row .* mount_on_rail a shorter"):
        env.reset(seed=0)


@pytest.mark.parametrize("reach", [0.0, -1.0, np.nan, "1", True, None])
def test_a_rail_needs_a_length(tmp_path: Path, reach: Any) -> None:
    with pytest.raises(InvalidValueError, match="reach must be metres above 0"):
        mount_on_rail("ur5e", tmp_path / "out.xml", reach)


def test_a_rail_is_mounted_once_and_into_another_file(arm: Path, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="moves already; give an arm with a fixed base"):
        mount_on_rail(arm, tmp_path / "twice.xml")
    with pytest.raises(InvalidValueError, match="the copy needs another file"):
        mount_on_rail("ur5e", get_robot("ur5e").path)
