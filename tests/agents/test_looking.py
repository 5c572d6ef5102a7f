"""Agents that look for fruit, and what they know of the space around them."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greenhouse_gym.agents import FixedViewsAgent, NextBestViewAgent, RandomViewsAgent, make_agent
from greenhouse_gym.agents.looking import OPACITY, CarvedSpace
from greenhouse_gym.agents.occupancy_map import wrist_camera
from greenhouse_gym.agents.viewpoints import OpaqueCells, visible
from greenhouse_gym.envs.tasks.look import MAP, RIPE
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation import AgentError, evaluate
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN

ARM = get_robot("ur5e")
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def space() -> CarvedSpace:
    return CarvedSpace(arm_spheres(ARM), ARM.start)


@pytest.mark.parametrize("kind", [NextBestViewAgent, FixedViewsAgent, RandomViewsAgent])
def test_views_find_fruit_and_nothing_is_touched(kind: type[NextBestViewAgent]) -> None:
    keywords = {"bank": "mini", "task": "look", "physics": "truth", "step_limit": 120, "progress": False}
    found = evaluate(kind(max_views=3), "train", 2, **keywords)
    assert found.failures == found.collision_rate == 0
    for record in found.records:
        assert record.measures["views"] == 3 or record.success
        assert 0 < record.measures["fraction_1"] <= record.measures["fraction_3"]
        assert record.joint_length > 0.2
    again = evaluate(kind(max_views=3), "train", 2, num_envs=2, **keywords)
    assert [r.measures for r in again.records] == [r.measures for r in found.records]


def test_agents_that_look_need_the_task() -> None:
    with pytest.raises(AgentError, match="needs task='look'"):
        evaluate(make_agent("next-best-view"), episodes=1, bank="mini", progress=False)
    with pytest.raises(InvalidValueError, match="max_views"):
        NextBestViewAgent(max_views=0)


def test_the_arm_moves_through_free_space_alone(space: CarvedSpace) -> None:
    there = ARM.start + np.array([0.0, 0.9, -0.4, 0.0, 0.0, 0.0])  # towards the plants
    path = np.linspace(ARM.start, there, 12)
    assert space.admits(ARM.start[None]), "the arm is where it stands"
    assert not space.admits(path), "nothing is known yet"
    space.update(np.full(MAP.shape, FREE, dtype=np.uint8))
    assert space.admits(path)
    tip = arm_spheres(ARM).centers(there[None])[0, -1]
    states = np.full(MAP.shape, FREE, dtype=np.uint8)
    states.reshape(-1)[MAP.indices(tip[None])] = OCCUPIED
    space.update(states)
    assert not space.admits(path)
    assert space.admits(path[:2])


def test_surfaces_and_the_arm_hide_what_is_behind_them() -> None:
    arm, rng = arm_spheres(ARM), np.random.default_rng(0)
    space = CarvedSpace(replace(arm, radius=np.zeros_like(arm.radius)), ARM.start)
    states = np.full(MAP.shape, FREE, dtype=np.uint8)
    states[10, 20:40, 5:30] = OCCUPIED
    states[12, :20] = RIPE
    space.update(states)
    opaque = OpaqueCells(states >= OCCUPIED, np.array(MAP.low), MAP.cell)
    configurations = ARM.start + rng.normal(0, 0.3, (30, 6))
    points = rng.uniform([0.3, -0.6, -0.5], [0.9, 0.6, 0.3], (200, 3))
    free, hidden = (space.shown(configurations, points, opacity) for opacity in (np.zeros(4), OPACITY))
    expected = visible(arm, configurations, points)
    assert ((free > 0) & expected).sum() == expected.sum()  # that one leaves out the edge of the image
    assert (free > 0).mean() < 1.2 * expected.mean()
    with_arm = CarvedSpace(arm, ARM.start)
    with_arm.update(states)
    unblocked = with_arm.shown(configurations, points, np.zeros(4))
    assert 0.1 < unblocked.sum() / free.sum() < 1.0
    assert (unblocked <= free).all()
    behind = visible(arm, configurations, points, opaque)
    in_both = expected & (free > 0)
    assert 0.1 < (behind & in_both).sum() / in_both.sum() < 0.9
    assert ((hidden > 0.5) == behind)[in_both].mean() > 0.97  # they sample rays at other points
    states[:] = UNKNOWN
    space.update(states)
    _, origins = wrist_camera(arm.chain, configurations)
    far = np.linalg.norm(points - origins[:, None], axis=2) > 0.6
    dim = space.shown(configurations, points, np.array([0.1, 0.0, 1.0, 1.0]))[in_both & far]
    assert 0 < dim.max() < 0.7, "unknown space may hide points"


def test_cells_that_are_worth_a_view(space: CarvedSpace) -> None:
    assert len(space.hiding()[0]) == len(space.zone())
    states = np.full(MAP.shape, UNKNOWN, dtype=np.uint8)
    states[:10] = FREE
    space.update(states)
    points, likely = space.hiding()
    assert 0 < len(points) < len(space.zone())
    assert points[:, 0].max() < MAP.low[0] + 12 * MAP.cell
    assert likely.sum() == pytest.approx(1.0)
    states[9, 30, 14] = RIPE
    space.update(states)
    points, boosted = space.hiding()
    near = np.linalg.norm(points - MAP.centers.reshape(*MAP.shape, 3)[9, 30, 14], axis=1) < 0.06
    assert boosted[near].min() > 2 * np.median(boosted[(np.abs(points[:, 1]) < 0.1) & ~near]), "fruit hang in trusses"
    space.note_view(ARM.start)
    seen = space.shown(ARM.start[None], points, OPACITY)[0] > 0.5
    assert seen.any()
    again = space.hiding()[1] / boosted
    assert again[seen].max() < again[~seen].min(), "cells that a view has shown count less"


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / "look_for_fruit.py"), run_name="__main__")
    assert "next-best-view" in capsys.readouterr().out
