"""Leaves that give way: they are felt and counted, and neither stop the arm nor end the episode."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
import pytest
from reach_helpers import REACH, scene_of, tool_at

from greenhouse_gym.crops.parts import MAX_LEAF, SpaceBox, Tomato, is_leaf
from greenhouse_gym.envs import GreenhouseEnv, GreenhouseVectorEnv, Randomization
from greenhouse_gym.envs.contacts import CONTACT_GROUPS, LEAF
from greenhouse_gym.envs.physics import Physics
from greenhouse_gym.envs.stepping import Start
from greenhouse_gym.envs.worlds import Worlds
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.geometry import Box, Capsule, Shape, Sphere
from greenhouse_gym.motion.collision import planning_model
from greenhouse_gym.motion.leaf_contacts import LeafContacts
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank, Shapes, compile_scene
from greenhouse_gym.scene.mjcf import YIELDING, make_yielding
from greenhouse_gym.scene.occupancy import boxes_covering
from greenhouse_gym.scene.truth import true_scene

KEYWORDS: dict[str, Any] = {"bank": "mini", "physics": "truth", "plants": "brush", "action": "tip_velocity"}


def wandering(count: int, seed: int) -> Any:
    """Tip velocities (count, 6) by step, which lead the tool into the plants, to and fro and up and down."""
    rng = np.random.default_rng(seed)
    phases, speeds = rng.uniform(0, 2 * np.pi, (count, 6)), rng.uniform(0.02, 0.15, (count, 6))
    scale, drift = np.array([0.3, 0.8, 0.8, 0.2, 0.2, 0.2]), np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])
    return lambda step: (drift + scale * np.sin(phases + speeds * step)).astype(np.float32)


def scene_with(*clutter: Any, tip: np.ndarray) -> Scene:
    scene = scene_of([Tomato(Sphere(tip + [0.3, 0.0, 0.0], 0.03), truss=0)])
    return scene.model_copy(update={"clutter": clutter})


@pytest.mark.parametrize(("margin", "gap", "pushes"), [(0.0, 0.0, True), (-YIELDING, YIELDING, False)])
def test_a_gap_below_the_margin_is_found_and_pushes_with_nothing(margin: float, gap: float, pushes: bool) -> None:
    """Pin the meaning of MuJoCo's gap: contacts are found below margin + gap, and push below the margin."""
    spec = mujoco.MjSpec()
    spec.option.gravity = [0.0, 0.0, 0.0]
    plate = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.01, 0.5, 0.5], margin=margin, gap=gap)
    plate.pos = [0.5, 0.0, 0.0]
    ball = spec.worldbody.add_body()
    ball.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0])
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.05, 0, 0], mass=1.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    found, forces = [], []
    for _ in range(500):
        mujoco.mj_step1(model, data)
        assert (data.ncon > 0) == (abs(data.qpos[0] - 0.5) < 0.06)
        found.append(data.ncon)
        mujoco.mj_step2(model, data)
        forces.append(np.abs(data.qfrc_constraint).max())
    assert sum(found) > 0
    assert (max(forces) > 0) == pushes
    assert (data.qvel[0] == 1.0) == (not pushes)


def rigid_clutter(shapes: Shapes) -> list[Shape]:
    clutter = np.arange(shapes.count - len(shapes.clutter), shapes.count)
    return [shapes.obstacles[k] for k in np.setdiff1d(clutter, shapes.leaves)]


def is_gutter(shape: Shape) -> bool:
    return isinstance(shape, Box) and 0.3 < shape.center[2] < 0.6


def test_leaves_are_all_clutter_except_gutters_and_boxes_over_space() -> None:
    half = np.array([MAX_LEAF, 0.05, 0.002])
    assert is_leaf(Box(np.zeros(3), half, np.eye(3)))
    assert is_leaf(Capsule(np.zeros(3), np.ones(3), 0.003))
    assert is_leaf(Sphere(np.zeros(3), 0.01))
    assert not is_leaf(Box(np.zeros(3), half + [1e-6, 0, 0], np.eye(3)))
    assert not is_leaf(SpaceBox(np.zeros(3), half / 2, np.eye(3)))
    cover = boxes_covering(np.ones((1, 1, 1), dtype=bool), np.zeros(3), 0.02)
    assert len(Shapes().with_space(cover).leaves) == 0
    long_leaves = {}
    for scene in SceneBank.open("mini"):
        assert scene.truth is not None
        (gutter,) = rigid_clutter(scene.truth)
        assert is_gutter(gutter)
        long_leaves[scene.name] = sum(not is_gutter(shape) for shape in rigid_clutter(scene))
    found = {name: count for name, count in long_leaves.items() if count}
    assert found == {"helios-cherry-2005-w01-00": 1}, "a leaf's box of 33 cm, which counts as rigid"


def test_the_motion_is_that_without_leaves_to_the_last_bit() -> None:
    scene = SceneBank.open("mini").scene("helios-beefsteak-2001-w05-01")
    leafless = [shape for shape in scene.clutter if not is_leaf(shape)]
    free = scene.model_copy(update={"clutter": tuple(leafless)})
    brushed = GreenhouseEnv(bank="mini", plants="brush", scene=scene, target=0, action="tip_velocity")
    bare = GreenhouseEnv(bank="mini", scene=free, target=0, action="tip_velocity")
    felt = 0.0
    for seed in range(2):
        actions = wandering(1, seed)
        seen = [env.reset(seed=seed)[0] for env in (brushed, bare)]
        for step in range(100):
            np.testing.assert_array_equal(*seen)
            one, two = (env.step(actions(step)[0]) for env in (brushed, bare))
            np.testing.assert_array_equal(brushed.simulation.joints, bare.simulation.joints)
            assert one[2:4] == two[2:4]
            felt += one[4]["brushing"]
            seen = [one[0], two[0]]
            if one[2]:
                break
    assert felt > 0.5


def test_the_vector_environment_equals_single_ones() -> None:
    count = 3
    vector = GreenhouseVectorEnv(count, **KEYWORDS, threads=1)
    singles = [GreenhouseEnv(**KEYWORDS) for _ in range(count)]
    seen, _ = vector.reset(seed=3)
    for i, env in enumerate(singles):
        np.testing.assert_array_equal(env.reset(seed=3 + i)[0], seen[i])
    actions, over, total = wandering(count, 1), np.zeros(count, dtype=bool), np.zeros(3)
    for step in range(70):
        seen, reward, terminated, truncated, infos = vector.step(actions(step))
        for i, env in enumerate(singles):
            if over[i]:
                env.reset()
                continue
            one = env.step(actions(step)[i])
            np.testing.assert_array_equal(one[0], seen[i])
            assert one[1:4] == (reward[i], terminated[i], truncated[i])
            for key in ("brushing", "brushed_time", "brushed_leaves"):
                assert one[4][key] == infos[key][i]
            assert one[4]["contacts"] == {group: infos["contacts"][group][i] for group in CONTACT_GROUPS}
            assert one[4]["reward_terms"]["brush"] == pytest.approx(-0.4 * infos["brushing"][i])
            total += [one[4][key] for key in ("brushing", "brushed_time", "brushed_leaves")]
        over = terminated | truncated
    assert (total > 0.5).all()


def test_counts_without_a_repetition_are_those_of_one() -> None:
    env = GreenhouseVectorEnv(4, **KEYWORDS, threads=1)
    env.reset(seed=0)
    actions, compared = wandering(4, 2), 0
    for step in range(140):
        physics: Physics = env.simulation._physics
        stepper = physics._stepper
        before = [array.copy() for array in (stepper.qpos, stepper.qvel, stepper.warmstart, stepper.command)]
        _, _, terminated, _, infos = env.step(actions(step))
        for i in np.flatnonzero(~terminated & (infos["brushing"] > 0)):
            counts, leaf_steps, contact = physics._repeat(i, Start._make(values[i] for values in before), 5)
            assert contact is None
            assert counts[LEAF] == infos["contacts"]["leaf"][i] == counts.sum()
            assert leaf_steps * 0.01 == pytest.approx(infos["brushing"][i])
            compared += 1
    assert compared > 30


def test_only_leaves_give_way() -> None:
    """Each kind of thing in the way of the tool: a leaf is passed, anything else ends the episode."""
    tip, frame = tool_at(REACH)
    ahead = tip + 0.08 * frame[:, 2]
    plate = np.array([0.05, 0.05, 0.002])
    things = {
        "leaf": scene_with(Box(ahead, plate, frame), tip=tip),
        "gutter": scene_with(Box(ahead, [0.16, 0.05, 0.002], frame), tip=tip),
        "space": scene_with(SpaceBox(ahead, plate, frame), tip=tip),
        "fruit": scene_with(tip=tip).model_copy(
            update={"tomatoes": (*scene_with(tip=tip).tomatoes, Tomato(Sphere(ahead, 0.03), truss=1))}
        ),
    }
    for kind, scene in things.items():
        env = GreenhouseEnv(bank="mini", plants="brush", start=REACH.tolist(), action="tip_velocity")
        env.reset(seed=0, options={"scene": scene, "target": 0})
        tool = env.simulation.state.axis[0]
        for _ in range(20):
            _, _, terminated, _, info = env.step(np.concatenate([tool, np.zeros(env.action_space.shape[0] - 3)]))
            if terminated:
                break
        assert info["collision"] == (kind != "leaf"), kind
        assert info["brushed_leaves"] == (kind == "leaf")
        assert (info["contacts"]["leaf"] > 0 or info["brushed_time"] > 0) == (kind == "leaf")


def test_touched_leaves_are_those_of_mujoco() -> None:
    scene = true_scene(SceneBank.open("mini").scene("helios-beefsteak-2001-w05-01"))
    compiled = compile_scene(scene, "ur5e")
    finder, slow = LeafContacts(compiled), LeafContacts(compiled)
    slow._world = None  # as for arms with parts that the kernels do not know
    rng = np.random.default_rng(0)
    configurations = get_robot("ur5e").start + rng.normal(0, 0.4, (200, 6))
    differences, found = 0, 0
    for configuration in configurations[:, None]:
        one, two = set(finder.at(configuration).tolist()), set(slow.at(configuration).tolist())
        differences, found = differences + len(one ^ two), found + len(two)
    assert found > 50
    assert differences <= 0.01 * found
    together = set(finder.at(configurations).tolist())
    assert together == set().union(*(finder.at(one).tolist() for one in configurations[:, None]))


def test_a_displaced_arm_touches_the_leaves_where_it_is() -> None:
    still = GreenhouseVectorEnv(2, **KEYWORDS)
    shaken = GreenhouseVectorEnv(2, **KEYWORDS, randomization=Randomization(base_position=0.02, base_yaw=0.05))
    for env in (still, shaken):
        env.reset(seed=4)
    finders = [env.simulation._physics._leaf_contacts for env in (still, shaken)]
    assert finders[0][0] is still.simulation._setup(0).world.leaf_contacts
    assert finders[1][0] is not shaken.simulation._setup(0).world.leaf_contacts
    copied = copy.deepcopy(shaken)
    actions = wandering(2, 6)
    for step in range(40):
        one, two = shaken.step(actions(step)), copied.step(actions(step))
        np.testing.assert_array_equal(one[4]["brushed_leaves"], two[4]["brushed_leaves"])


def test_a_model_for_planning_ignores_what_gave_way_in_the_simulation() -> None:
    """Margins are set with their gaps, so that leaves of a model that lets them give way are obstacles again."""
    tip, frame = tool_at(REACH)
    scene = scene_with(Box(tip, [0.05, 0.05, 0.002], frame), tip=tip)
    compiled = compile_scene(scene, "ur5e")
    make_yielding(compiled.model, compiled.leaf_geoms)
    for leaves, contacts in (("rigid", True), ("brush", False)):
        model = planning_model(compiled, 0, leaves=leaves)
        data = mujoco.MjData(model)
        data.qpos[:] = REACH
        mujoco.mj_forward(model, data)
        assert (data.ncon > 0) == contacts
        assert not model.geom_gap.any()


def test_worlds_of_both_kinds_do_not_mix() -> None:
    scene = SceneBank.open("mini").scene("own-cluster-2000-w00-02")
    rigid = Worlds(get_robot("ur5e"), "reconstruction", 300).world(scene)
    brush = Worlds(get_robot("ur5e"), "reconstruction", 300, leaves="brush").world(scene)
    assert not rigid.compiled.model.geom_gap.any()
    assert (np.flatnonzero(brush.compiled.model.geom_gap) == brush.compiled.leaf_geoms).all()


def test_unknown_plants_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="plants"):
        GreenhouseEnv(bank="mini", plants="soft")
    pytest.importorskip("warp")
    from greenhouse_gym.envs.warp import WarpVectorEnv

    with pytest.raises(InvalidValueError, match=r'plants=\'brush\'.*backend="mujoco"'):
        WarpVectorEnv(2, bank="mini", plants="brush", device="cpu")


def test_hindsight_pays_for_brushing_as_the_step_did() -> None:
    scene = SceneBank.open("mini").scene("helios-beefsteak-2001-w05-01")
    keywords = {"scene": scene, "target": 0, "action": "tip_velocity"}
    env = GreenhouseEnv(bank="mini", plants="brush", observation="goal", **keywords)
    env.reset(seed=1)
    actions, paid = wandering(1, 3), 0.0
    for step in range(100):
        seen, reward, terminated, _, info = env.step(actions(step)[0])
        assert env.compute_reward(seen["achieved_goal"], seen["desired_goal"], info) == reward
        paid += info["reward_terms"]["brush"]
        if terminated:
            env.reset()
    assert paid < 0
