"""Worlds out of reach are hidden from MuJoCo, and trees lack parked geoms, without a change of any number."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
import pytest

from greenhouse_gym.envs import GreenhouseVectorEnv, hidden_worlds, stepping
from greenhouse_gym.envs.contacts import CONTACT_GROUPS
from greenhouse_gym.envs.hidden_worlds import HiddenWorlds
from greenhouse_gym.robots import get_robot, mount_on_rail
from greenhouse_gym.scene import SceneBank, compile_scene
from greenhouse_gym.scene.arm_spheres import arm_spheres
from greenhouse_gym.scene.geom_order import put_arm_first
from greenhouse_gym.scene.reach_kernels import mark_far, mark_near
from greenhouse_gym.scene.truth import true_scene
from greenhouse_gym.scene.world_tree import WorldTree, world_tree


def rollout(options: dict[str, Any], steps: int = 120, copied: bool = False) -> list[np.ndarray]:
    """Return all numbers of random steps in long directions, in which arms meet plants, themselves and their limits."""
    env = GreenhouseVectorEnv(8, bank="mini", **options)
    env.reset(seed=4)
    rng, rows = np.random.default_rng(4), []
    for k in range(steps):
        if k % 8 == 0:
            action = rng.uniform(-1, 1, (8, 6)).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        contacts = np.column_stack([info["contacts"][group] for group in CONTACT_GROUPS])
        rows.append((observation, reward, terminated, truncated, contacts, env.simulation.joints.copy()))
        if copied and k == steps // 2:
            env = copy.deepcopy(env)
    return [np.array(column) for column in zip(*rows, strict=True)]


def assert_same(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


VARIANTS: list[dict[str, Any]] = [
    {},
    {"physics": "truth"},
    {"physics": "truth", "plants": "brush"},
    {"robot": "iiwa14"},
    {"rate": 5},
]


@pytest.mark.parametrize("options", VARIANTS, ids=lambda options: "-".join(map(str, options.values())) or "default")
def test_hidden_worlds_change_no_number(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(HiddenWorlds, "hide", lambda *_: None)
    expected = rollout(options)
    assert expected[4].sum() > 20
    monkeypatch.undo()
    shares, show = [], HiddenWorlds.hide

    def hide(self: HiddenWorlds, *poses: Any) -> None:
        show(self, *poses)
        shares.append(1 - self._near[:, self._collide].mean())

    monkeypatch.setattr(HiddenWorlds, "hide", hide)
    assert_same(rollout(options), expected)
    assert np.mean(shares) > 0.3
    assert_same(rollout(options, copied=True), expected)


@pytest.mark.parametrize("physics", ["reconstruction", "truth"])
def test_actions_that_turn_farther_than_foreseen_are_repeated(physics: str, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = rollout({"physics": physics})
    repeated, repeat = [], stepping.ManyStepper._repeat

    def record(self: stepping.ManyStepper, ids: np.ndarray, *start: Any) -> None:
        repeated.append(len(ids))
        repeat(self, ids, *start)

    monkeypatch.setattr(stepping.ManyStepper, "_repeat", record)
    assert_same(rollout({"physics": physics}), expected)
    foreseen = stepping.foreseen
    usually = sum(repeated)
    monkeypatch.setattr(stepping, "foreseen", lambda *state: 0.5 * (foreseen(*state) - hidden_worlds.LAG))
    assert_same(rollout({"physics": physics}), expected)
    assert 10 * usually < sum(repeated) - usually


def test_the_masks_are_those_of_the_model_while_arms_are_placed() -> None:
    env = GreenhouseVectorEnv(4, bank="mini")
    env.reset(seed=0)
    models, stepper = env.simulation._physics.models, env.simulation._physics._stepper
    shown = [(model.body_contype.copy(), model.body_conaffinity.copy()) for model in models]
    env.step(np.zeros((4, 6)))
    assert any(model.body_contype[0] == 0 for model in models)
    stepper.place(np.array([0, 2]), stepper.qpos[[0, 2]])
    for i in (0, 2):
        np.testing.assert_array_equal((models[i].body_contype, models[i].body_conaffinity), shown[i])


@pytest.mark.parametrize("rail", [False, True])
def test_an_arm_stays_within_the_reach_that_is_searched(rail: bool, tmp_path: Any) -> None:
    robot = get_robot(mount_on_rail("ur5e", tmp_path / "rail.xml") if rail else "ur5e")
    bank = SceneBank.open("mini")
    model = compile_scene(bank.scene(bank.names()[0]), robot).model
    count, rng, data = len(robot.joints), np.random.default_rng(0), mujoco.MjData(model)
    arm = arm_spheres(model, count)
    assert arm.slides.sum() == rail

    def middles() -> np.ndarray:
        mujoco.mj_kinematics(model, data)
        frames = data.xmat.reshape(-1, 3, 3)[arm.bodies]
        return np.asarray(data.xpos[arm.bodies] + np.einsum("sij,sj->si", frames, arm.middles))

    for _ in range(200):
        turns = rng.uniform(0, 0.2, count) * (rng.random(count) < 0.7)
        data.qpos[:] = rng.uniform(np.maximum(robot.lower, -3), np.minimum(robot.upper, 3))
        middles()
        poses = (data.xpos[arm.frames].copy()[None], data.xmat[arm.frames].copy()[None])
        anchors = data.xanchor.copy()[None]
        data.qpos[:] += turns * rng.choice([-1, 1], count)
        after = middles()
        # a box without extent on the skin of each sphere where it ends up has to be near
        ends = after + 0.999 * arm.radii[:, None] * np.eye(3)[rng.integers(3, size=len(after))]
        far = np.empty((1, len(ends)), dtype=np.bool_)
        mark_far(*poses, *arm, anchors, turns[None], np.array([[ends, ends]]), far)
        assert not far.any()
        for s in range(len(ends)):
            near = np.empty((1, model.nbody), dtype=np.bool_)
            tree = np.hstack([ends[s], ends[s]]).astype(np.float32)[None, None]
            memory = np.zeros((1, len(ends), 3)), np.full((1, len(ends)), -1.0)
            mark_near(
                *poses, *arm, anchors, turns[None] + 1e-6, tree, np.ones((1, 1), np.int32), np.ones(1, np.int64),
                *memory, near,
            )  # fmt: skip
            assert near[0, arm.bodies[s]]


def test_what_was_found_clear_before_is_as_found_anew() -> None:
    env = GreenhouseVectorEnv(2, bank="mini", physics="truth")
    env.reset(seed=1)
    stepper = env.simulation._physics._stepper
    hidden, rng, seen = stepper._hidden, np.random.default_rng(0), []
    for k in range(150):
        env.step(rng.uniform(-1, 1, (2, 6)) if k % 5 == 0 else np.ones((2, 6)) * np.sin(k))
        turns = rng.uniform(0, 0.1, (2, 6))
        tree = hidden._boxes, hidden._after, hidden._sizes
        found, anew = np.empty((2, 2, hidden._near.shape[1]), dtype=np.bool_)
        mark_near(*stepper._bodies, *hidden._arm, stepper.xanchor, turns, *tree, hidden._centers, hidden._clear, found)
        forgotten = np.zeros_like(hidden._centers), np.full_like(hidden._clear, -1.0)
        mark_near(*stepper._bodies, *hidden._arm, stepper.xanchor, turns, *tree, *forgotten, anew)
        assert not (anew & ~found).any()
        seen.append((anew.any(), found.any()))
    assert 0 < np.mean(seen, axis=0)[0] < 1


def leaves_below(tree: WorldTree, node: int) -> list[int]:
    return [node] if tree.child[node, 0] < 0 else [k for part in tree.child[node] for k in leaves_below(tree, part)]


def test_a_tree_holds_what_is_used_and_finds_the_same_contacts() -> None:
    bank, rng, touches = SceneBank.open("mini"), np.random.default_rng(0), 0
    for name in bank.names()[:2]:
        scene = true_scene(bank.scene(name))
        compiled = compile_scene(scene, "ur5e", scene.count + 500)
        used = int(compiled.obstacle_geoms.start) + scene.count
        tree = world_tree(compiled.model, used)
        assert sorted(tree.geom[tree.geom >= 0]) == list(range(used))
        assert sorted(leaves_below(tree, 0)) == np.flatnonzero(tree.geom >= 0).tolist()
        for node in range(len(tree.geom)):
            inside = tree.aabb[leaves_below(tree, node)]
            assert (
                np.abs(inside[:, :3] - tree.aabb[node, :3]) + inside[:, 3:] <= tree.aabb[node, 3:] * (1 + 1e-9)
            ).all()
        reach = tree.reach
        assert (reach.after > np.arange(len(reach.after))).all()
        assert (reach.after == np.arange(len(reach.after)) + 1).sum() >= used
        whole = copy.copy(compiled.model)
        put_arm_first(whole)
        small = copy.copy(whole)
        tree.load(small)
        for _ in range(40):
            data, other = mujoco.MjData(whole), mujoco.MjData(small)
            data.qpos[:] = other.qpos[:] = rng.uniform(-3, 3, 6)
            mujoco.mj_step1(whole, data)
            mujoco.mj_step1(small, other)
            np.testing.assert_array_equal(data.contact.dist, other.contact.dist)
            np.testing.assert_array_equal(data.contact.pos, other.contact.pos)
            touches += data.ncon
    assert touches > 100
