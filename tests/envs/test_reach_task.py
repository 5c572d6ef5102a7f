from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from greenhouse_gym.envs.reach_task import (
    ACTION_STEP,
    MAX_LEAD,
    REWARDS,
    STEP_LIMIT,
    Situation,
    check_actions,
    joint_command,
    total_reward,
)
from greenhouse_gym.errors import InvalidValueError


def situation(distance: float, touched: bool = False) -> Situation:
    z = np.zeros((1, 6))
    return Situation(
        joints=z, velocities=z, command=z, grasp=np.zeros((1, 3)), target=np.zeros((1, 3)),
        distance=np.array([distance]), clearance=np.ones((1, 9), dtype=np.float32),
        obstacle=np.zeros((1, 9, 3), dtype=np.float32), touched=np.array([touched]),
    )  # fmt: skip


def episode_return(reward: str, distances: np.ndarray, actions: np.ndarray, crash: bool) -> float:
    total = 0.0
    for i, action in enumerate(actions):
        last = i == len(actions) - 1
        before, after = situation(distances[i]), situation(distances[i + 1], touched=crash and last)
        total += float(total_reward(REWARDS[reward](before, after, action[None]))[0])
    return total


@pytest.mark.parametrize("reward", REWARDS)
def test_the_worst_success_beats_the_best_crash(reward: str) -> None:
    random = np.random.default_rng(0)
    for start in (0.05, 0.6, 1.5):
        slow = np.append(random.uniform(0.1, 2.0, STEP_LIMIT), 0.0199)
        slow[0] = start
        worst = episode_return(reward, slow, np.ones((STEP_LIMIT, 6)), crash=False)
        best = episode_return(reward, np.array([start, 0.0]), np.zeros((1, 6)), crash=True)
        assert worst > best + 1


def test_progress_telescopes() -> None:
    distances = np.random.default_rng(1).uniform(0.1, 1.0, 31)
    terms = [
        REWARDS["dense"](situation(a), situation(b), np.zeros((1, 6)))["progress"][0] for a, b in pairwise(distances)
    ]
    assert sum(terms) == pytest.approx(4.0 * (distances[0] - distances[-1]))


def test_success_needs_nearness_and_no_touch() -> None:
    assert situation(0.0199).success.tolist() == [True]
    assert situation(0.0201).success.tolist() == [False]
    assert situation(0.0, touched=True).success.tolist() == [False]


def test_commands_stay_near_the_joints_and_within_limits() -> None:
    random = np.random.default_rng(2)
    lower, upper = -np.ones(6), np.ones(6)
    for _ in range(100):
        joints = random.uniform(-1, 1, (7, 6))
        command = np.clip(joints + random.uniform(-0.5, 0.5, (7, 6)), lower, upper)
        moved = joint_command(command, random.uniform(-1, 1, (7, 6)), joints, lower, upper)
        assert (np.abs(moved - joints) <= MAX_LEAD + 1e-12).all()
        assert (np.abs(moved) <= 1).all()
    still = np.zeros((1, 6))
    np.testing.assert_allclose(joint_command(still, np.full((1, 6), 0.5), still, lower, upper), 0.5 * ACTION_STEP)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((2, 5)), "shape"),
        (np.zeros(6), "shape"),
        (np.full((2, 6), np.nan), "finite"),
        (np.array([[0, 0, 0, 0, 0, 0], [0, 0, np.inf, 0, 0, 0]]), r"index \[1, 2\]"),
        ("left", "numbers"),
    ],
)
def test_bad_actions_are_named(actions: object, message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        check_actions(actions, (2, 6))
