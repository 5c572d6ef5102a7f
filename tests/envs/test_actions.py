from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from greenhouse_gym.envs.actions import ACTIONS, CommandLimits, check_actions
from greenhouse_gym.envs.rewards import REWARDS, Transition, total_reward
from greenhouse_gym.envs.state import ACTION_STEP, MAX_COMMAND_ERROR, STEP_LIMIT, control_timing
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.motion.success import SUCCESS_RADIUS
from greenhouse_gym.robots import get_robot

INTERVAL = control_timing(20).interval


def transition(before: float, after: float, collided: bool = False, effort: float = 0.0) -> Transition:
    success = after < SUCCESS_RADIUS and not collided
    return Transition(*(np.array([value]) for value in (before, after, collided, success, effort, 1)))


def episode_return(reward: str, distances: np.ndarray, actions: np.ndarray, crash: bool) -> float:
    total = 0.0
    for i, action in enumerate(actions):
        last = i == len(actions) - 1
        step = transition(distances[i], distances[i + 1], crash and last, float(action @ action))
        total += float(total_reward(REWARDS[reward](step))[0])
    return total


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_the_worst_success_beats_the_best_crash(reward: str) -> None:
    random = np.random.default_rng(0)
    for start in (0.05, 0.6, 1.5):
        slow = np.append(random.uniform(0.1, 2.0, STEP_LIMIT), 0.0199)
        slow[0] = start
        worst = episode_return(reward, slow, np.ones((STEP_LIMIT, 7)), crash=False)
        best = episode_return(reward, np.array([start, 0.0]), np.zeros((1, 7)), crash=True)
        assert worst > best + 1


def test_progress_telescopes() -> None:
    distances = np.random.default_rng(1).uniform(0.1, 1.0, 31)
    terms = [REWARDS["dense"](transition(a, b))["progress"][0] for a, b in pairwise(distances)]
    assert sum(terms) == pytest.approx(4.0 * (distances[0] - distances[-1]))


@pytest.mark.parametrize("name", ["ur5e", "iiwa14"])
@pytest.mark.parametrize("kind", ["joint", "joint_velocity"])
def test_commands_stay_near_the_joints_and_within_limits(name: str, kind: str) -> None:
    random, robot = np.random.default_rng(2), get_robot(name)
    rule = ACTIONS[kind](robot, INTERVAL)
    limit = CommandLimits(robot, rule)
    size, stopped = len(robot.joints), 0
    for _ in range(100):
        joints = random.uniform(robot.lower, robot.upper, (7, size))
        last = np.clip(joints + random.uniform(-0.15, 0.15, joints.shape), robot.lower, robot.upper)
        command = limit(last, rule(random.uniform(-1, 1, joints.shape), None, None), joints)
        moved = command.position - last
        assert (np.abs(command.position - joints) <= MAX_COMMAND_ERROR + 1e-12).all()
        assert ((robot.lower <= command.position) & (command.position <= robot.upper)).all()
        assert (np.abs(moved) <= robot.velocity_limits * INTERVAL + 1e-9).all()
        at_limit = (command.position == robot.lower) | (command.position == robot.upper)
        assert (command.position_limited <= at_limit.sum(axis=1)).all()
        stopped += int(command.position_limited.sum())
    assert stopped > 0
    still = np.zeros((1, size))
    half = limit(still, rule(np.full((1, size), 0.5), None, None), still).position
    full = np.minimum(ACTION_STEP, robot.velocity_limits * INTERVAL) if kind == "joint" else rule.peak
    if name == "ur5e" or kind == "joint_velocity":
        np.testing.assert_allclose(half[0], 0.5 * full)


def test_a_wish_that_is_too_fast_is_slowed_as_a_whole() -> None:
    robot = get_robot("iiwa14")  # slower than a joint action may ask for
    rule = ACTIONS["joint"](robot, INTERVAL)
    action = np.array([[1.0, 0.5, 0.0, -1.0, 0.2, 0.1, -0.3], [0.1] * 7])
    still = np.zeros((2, 7))
    command = CommandLimits(robot, rule)(still, rule(action, None, None), still)
    assert command.speed_limited.tolist() == [True, False]
    np.testing.assert_allclose(command.position[1], 0.1 * ACTION_STEP)
    np.testing.assert_allclose(np.abs(command.position[0]).max(), robot.velocity_limits[3] * INTERVAL)
    np.testing.assert_allclose(np.cross(command.position[0, :3], action[0, :3]), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((2, 5)), "shape"),
        (np.zeros(6), "shape"),
        (np.full((2, 6), np.nan), "finite"),
        (np.array([[0, 0, 0, 0, 0, 0], [0, 0, np.inf, 0, 0, 0]]), r"index \[1, 2\]"),
        ("left", "numbers"),
        (np.zeros((2, 6), dtype=complex), "real numbers"),
        ([["0.1"] * 6] * 2, "real numbers"),
        (np.zeros((2, 6), dtype="datetime64[s]"), "real numbers"),
        ([[None] * 6] * 2, "real numbers"),
        ([[0.0], [0.0, 1.0]], "numbers"),
    ],
)
def test_bad_actions_are_named(actions: object, message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        check_actions(actions, 2, ACTIONS["joint"](get_robot("ur5e"), INTERVAL).space)
