from __future__ import annotations

import copy
import subprocess
import sys
import warnings
from collections.abc import Callable
from itertools import product
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from reach_helpers import REACH, scene_of, tool_at, touched_in_plain_mujoco

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.envs.actions import ACTIONS
from greenhouse_gym.envs.choices import OBSERVATIONS
from greenhouse_gym.envs.features import feature_slices
from greenhouse_gym.envs.rewards import REWARDS
from greenhouse_gym.errors import InvalidValueError, UnknownKeywordError, UnknownNameError
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.robots import ROBOTS
from greenhouse_gym.scene import Scene, SceneBank, Shapes
from greenhouse_gym.scene.geom_order import first_world_geom, put_arm_first


def make(bank: SceneBank, **keywords: Any) -> GreenhouseEnv:
    return gymnasium.make("TomatoReach-v0", bank=bank, disable_env_checker=True, **keywords).unwrapped


def play(env: GreenhouseEnv, seed: int | None, actions: np.ndarray) -> list[tuple[Any, ...]]:
    observation, info = env.reset(seed=seed)
    seen: list[tuple[Any, ...]] = [(observation, info)]
    for action in actions:
        seen.append(env.step(action))
        if seen[-1][2] or seen[-1][3]:
            break
    return seen


def same(a: Any, b: Any) -> bool:
    if isinstance(a, (tuple, list)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(np.array_equal(a, b)) if isinstance(a, np.ndarray) else bool(a == b)


PLAIN = [name for name in OBSERVATIONS if name != "state_occupancy"]  # the made-up scenes do not say what was seen
KINDS = [
    *product(["TomatoReach-v0"], ROBOTS, PLAIN, ACTIONS, [name for name in REWARDS if name != "path"]),
    *product(["TomatoReach-v0"], ROBOTS, ["state", "depth", "roadmap"], ["joint"], ["path"]),
    *product(["TomatoLook-v0"], ROBOTS, ["task", "state", "rgbd"], ["joint", "tip_velocity"], ["dense", "sparse"]),
]


@pytest.mark.parametrize(("env_id", "robot", "observation", "action", "reward"), KINDS)
def test_gymnasium_and_stable_baselines_accept_it(
    env_id: str, robot: str, observation: str, action: str, reward: str, bank: SceneBank
) -> None:
    from stable_baselines3.common.env_checker import check_env as check_for_sb3

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # It prefers pictures of bytes; these are metres over 2 m.
        warnings.filterwarnings("ignore", message=".*(image|observation space).*")
        keywords = {"robot": robot, "observation": observation, "action": action, "reward": reward}
        env = gymnasium.make(env_id, bank=str(bank.path), **keywords)
        check_env(env.unwrapped, skip_render_check=True)  # "human" needs a display
        check_for_sb3(env.unwrapped, warn=True)


def test_twins_with_one_seed_agree_and_other_seeds_differ(bank: SceneBank) -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, (60, 6))
    first, twin, other = (play(make(bank), seed, actions) for seed in (3, 3, 4))
    assert same(first, twin)
    assert not same(first[0], other[0])


def test_a_dirty_environment_resets_to_the_same_as_a_fresh_one(bank: SceneBank) -> None:
    actions = np.random.default_rng(1).uniform(-1, 1, (80, 6))
    dirty = make(bank)
    for seed in range(6):
        play(dirty, seed, np.ones((40, 6)) * [0, 1, 1, 0, 0, 0])
    for seed in (11, 12):
        assert same(play(dirty, seed, actions), play(make(bank), seed, actions))


def test_collisions_are_those_of_plain_mujoco_in_every_substep(bank: SceneBank) -> None:
    env, random, crashes = make(bank), np.random.default_rng(2), 0
    for episode in range(30):
        env.reset(seed=episode)
        drift, commands, collisions = random.uniform(-1, 1, 6), [], []
        drift[1] = abs(drift[1])  # towards the plants
        for _ in range(60):
            _, _, terminated, _, info = env.step(drift + random.uniform(-0.3, 0.3, 6))
            commands.append(env.simulation.command[0].copy())
            collisions.append(info["collision"])
            assert bool(info["contact"]) == info["collision"]
            if terminated:
                break
        expected = touched_in_plain_mujoco(env.scene, env.target, env.start, commands)
        assert collisions == expected
        crashes += collisions[-1]
    assert crashes > 10


def test_private_model_equals_the_compiled_scene(bank: SceneBank) -> None:
    env = make(bank)
    for seed in range(5):
        env.reset(seed=seed)
        simulation = env.simulation
        private, compiled = simulation._physics.models[0], simulation.physical(0)[0]
        reordered = copy.copy(compiled.model)
        put_arm_first(reordered)
        simulation._setup(0).world.tree.load(reordered)
        nodes = int(reordered.body_bvhnum[0])
        geom = first_world_geom(private) + compiled.tomato_geom(env.target)
        assert private.geom_contype[geom] == private.geom_conaffinity[geom] == 1
        for name in dir(compiled.model):
            value = getattr(reordered, name)
            if not isinstance(value, np.ndarray) or name.startswith(("name", "paths")) or name.endswith("nameadr"):
                continue
            mine = getattr(private, name).copy()
            if name.startswith("bvh_"):  # the nodes after those of the tree belong to no body
                mine[nodes : compiled.model.body_bvhnum[0]] = value[nodes : compiled.model.body_bvhnum[0]]
            if name == "bvh_depth":  # which drawings alone use
                continue
            if name in ("geom_contype", "geom_conaffinity"):
                mine[geom] = value[geom]
            np.testing.assert_array_equal(mine, value, err_msg=name)


def test_nothing_is_compiled_twice(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make(bank)
    for seed in range(30):
        env.reset(seed=seed)
    monkeypatch.setattr(mujoco.MjSpec, "compile", lambda self: pytest.fail("compiled again"))
    for seed in range(30):
        env.reset(seed=seed)


def test_reward_is_the_sum_of_its_terms_and_progress_telescopes(bank: SceneBank) -> None:
    env = make(bank)
    first, *steps = play(env, 5, np.random.default_rng(3).uniform(-1, 1, (50, 6)))
    for _, reward, _, _, info in steps:
        assert reward == pytest.approx(sum(info["reward_terms"].values()), abs=1e-12)
    progress = sum(info["reward_terms"]["progress"] for *_, info in steps)
    assert progress == pytest.approx(4 * (first[1]["distance"] - steps[-1][4]["distance"]))


def test_observation_says_what_it_promises(bank: SceneBank) -> None:
    env = make(bank, start="upright")
    env.reset(seed=1)
    for action in np.random.default_rng(4).uniform(-0.3, 0.3, (25, 6)):
        observation, *_ = env.step(action)
    model, data = env.model_and_data()
    tomato = env.scene.tomatoes[env.target]
    site = model.site("tip").id
    tip, axis = data.site_xpos[site], data.site_xmat[site].reshape(3, 3)[:, 2]
    base = model.body("base").pos
    direction = (tomato.center - tip) / np.linalg.norm(tomato.center - tip)
    assert observation.dtype == np.float32
    assert env.observation_space.contains(observation)
    layout = feature_slices(env.simulation.observe.layout)
    for name, expected in {
        "joint_position": data.qpos, "joint_velocity": data.qvel, "command_error": data.act - data.qpos,
        "tip_position": tip - base, "tool_axis": axis, "grasp_offset": tomato.center - tip - tomato.radius * axis,
        "target_position": tomato.center - base, "target_direction": direction,
        "turn_to_target": np.cross(axis, direction),
    }.items():  # fmt: skip
        np.testing.assert_allclose(observation[layout[name]], expected, atol=1e-5, err_msg=name)
    others = [s for s in env.scene.obstacles if s is not tomato]
    from greenhouse_gym.geometry import distance_to_shapes

    probes = [data.site(name).xpos for name in env.robot.probes]
    clearance = np.minimum(distance_to_shapes(probes, others).min(axis=1), 0.3) - env.robot.probe_radii
    np.testing.assert_allclose(observation[layout["clearance"]], clearance, atol=0.011)
    lengths = np.linalg.norm(observation[layout["obstacle_direction"]].reshape(9, 3), axis=1)
    assert (np.isclose(lengths, 1, atol=1e-3) | (lengths == 0)).all()


def test_turned_and_moved_stand_gives_the_same_episode() -> None:
    tip, frame = tool_at(REACH)
    from greenhouse_gym.geometry import pose, rotation_about, transform
    from greenhouse_gym.scene import ArmPlacement

    move = pose(rotation_about([0, 0, 1], 0.7), [0.4, -0.3, 0.0])
    tomatoes = [Tomato(Sphere(tip + 0.2 * frame[:, 2] + [0, 0.1 * k, 0], 0.03), truss=0) for k in range(3)]
    stems = [Stem([0.7, 0.05, 0.5], [0.7, 0.05, 1.8], 0.006, kind="main")]
    here = scene_of(tomatoes, stems)
    there = scene_of(
        [Tomato(Sphere(transform(move, [t.center])[0], t.radius), truss=0) for t in tomatoes],
        [Stem(*transform(move, [s.start, s.end]), s.radius, kind=s.kind) for s in stems],
    ).model_copy(update={"placement": ArmPlacement(position=move[:3, 3], yaw=0.7)})
    seen = []
    for placed in (here, there):
        env = make_for(placed)
        env.reset(seed=0, options={"scene": placed, "target": 1, "start": REACH})
        seen.append([env.step(0.4 * np.ones(6))[0] for _ in range(5)][-1])
    # the distance field's grid turns with the arm, so only its interpolation differs
    np.testing.assert_allclose(seen[0], seen[1], atol=2e-3)


def make_for(scene: Scene, **keywords: Any) -> GreenhouseEnv:
    import tempfile

    from greenhouse_gym.scene.bank import write_bank

    with tempfile.TemporaryDirectory() as folder:
        return make(write_bank(folder, [(scene, "train")], name="one"), **keywords)


def drive(env: GreenhouseEnv, goal: np.ndarray, steps: int = 60) -> tuple[Any, ...]:
    for _ in range(steps):
        error = goal - env.simulation.command[0]
        result = env.step(np.clip(error / 0.08, -1, 1))
        if result[2] or result[3]:
            break
    return result


def test_reaching_the_target_is_a_success() -> None:
    tip, frame = tool_at(REACH)
    placed = scene_of([Tomato(Sphere(tip + 0.03 * frame[:, 2], 0.03), truss=0)])
    env = make_for(placed, action="joint")
    env.reset(options={"scene": placed, "target": 0, "start": REACH - [0.0, 0.25, -0.1, 0, 0, 0]})
    _, reward, terminated, truncated, info = drive(env, REACH)
    assert (terminated, truncated) == (True, False)
    assert info["is_success"]
    assert not info["collision"]
    assert info["distance"] < 0.02
    assert reward > 9


@pytest.mark.parametrize(("target", "touching"), [(0, False), (1, True)])
def test_only_the_cup_may_touch_only_the_target(target: int, touching: bool) -> None:
    tip, frame = tool_at(REACH)
    beside_the_cup = Tomato(Sphere(tip + 0.03 * frame[:, 0], 0.025), truss=0)
    elsewhere = Tomato(Sphere([0.3, 0.9, 1.0], 0.025), truss=1)
    placed = scene_of([beside_the_cup, elsewhere])
    env = make_for(placed)
    _, info = env.reset(options={"scene": placed, "target": target, "start": REACH})
    assert info["collision"] == touching
    assert info["contact"] == ("cup, tomato_0" if touching else "")
    *_, info = env.step(np.zeros(6))
    assert info["collision"] == touching


def test_the_rod_may_not_touch_the_target() -> None:
    tip, frame = tool_at(REACH)
    placed = scene_of([Tomato(Sphere(tip - 0.1 * frame[:, 2] + 0.03 * frame[:, 0], 0.025), truss=0)])
    env = make_for(placed)
    env.reset(options={"scene": placed, "target": 0, "start": REACH})
    _, reward, terminated, _, info = env.step(np.zeros(6))
    assert terminated
    assert info["contact"] == "rod, tomato_0"
    assert info["reward_terms"]["collision"] == -5
    assert reward < -0.9


def test_episodes_are_truncated_by_the_task(bank: SceneBank) -> None:
    env = make(bank)
    steps = play(env, 0, np.zeros((300, 6)))[1:]
    assert len(steps) == 200
    assert [s[3] for s in steps] == [False] * 199 + [True]
    assert not steps[-1][2]


def test_the_state_holds_the_tool_and_its_turn_to_the_target(bank: SceneBank) -> None:
    env = make(bank, robot="iiwa14", action="tip_velocity")
    observation = play(env, 1, np.random.default_rng(1).uniform(-1, 1, (5, 6)))[-1][0]
    parts = {name: observation[part] for name, part in feature_slices(env.simulation.observe.layout).items()}
    tip, axis = env.simulation.state.tip[0], env.simulation.state.axis[0]
    np.testing.assert_allclose(parts["tip_position"], tip, atol=1e-6)
    np.testing.assert_allclose(parts["tool_axis"], axis, atol=1e-6)
    offset = parts["target_position"] - tip
    np.testing.assert_allclose(parts["target_direction"], offset / np.linalg.norm(offset), atol=1e-5)
    np.testing.assert_allclose(parts["turn_to_target"], np.cross(axis, parts["target_direction"]), atol=1e-5)


def test_options_fix_scene_target_and_start(bank: SceneBank) -> None:
    env = make(bank, split="train")
    name = bank.names("test")[0]
    start = np.array([0.1, -1.5, 0.2, -1.4, 0.0, 0.3])
    observation, info = env.reset(seed=0, options={"scene": name, "target": 5, "start": start})
    assert (info["scene"], info["target"], info["difficulty"]) == (name, 5, "easy")
    np.testing.assert_allclose(observation[:6], start, atol=1e-6)
    observation, _ = env.reset(seed=0, options={"scene": name, "target": 5, "start": "folded"})
    np.testing.assert_allclose(observation[:6], env.robot.starts["folded"], atol=1e-6)
    drawn = {env.reset()[1]["scene"] for _ in range(20)}
    assert drawn <= set(bank.names("train"))
    assert len(drawn) > 1


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"scne": "x"}, UnknownNameError),
        ({"scene": "nowhere"}, UnknownNameError),
        ({"target": 1}, InvalidValueError),
        ({"scene": "made-up-0", "target": 99}, InvalidValueError),
        ({"scene": "made-up-0", "target": -1}, InvalidValueError),
        ({"scene": "made-up-0", "target": "first"}, InvalidValueError),
        ({"start": "asleep"}, UnknownNameError),
        ({"start": [0, 0]}, InvalidValueError),
        ({"start": [0, np.nan, 0, 0, 0, 0]}, InvalidValueError),
        ({"start": [9, 0, 0, 0, 0, 0]}, InvalidValueError),
    ],
)
def test_bad_options_are_named(bank: SceneBank, options: dict[str, Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        make(bank).reset(options=options)


@pytest.mark.parametrize(
    "keyword",
    [
        {"observation": "smell"}, {"action": "wish"}, {"reward": "fame"}, {"robot": "ur9"}, {"bank": "money"},
        {"split": "tset"}, {"difficulty": "trivial"}, {"difficulty": ("easy", "x")}, {"physics": "cartoon"},
        {"render_mode": "hologram"},
    ],
)  # fmt: skip
def test_unknown_names_are_answered_with_the_choices(bank: SceneBank, keyword: dict[str, Any]) -> None:
    with pytest.raises(UnknownNameError, match="Choices: "):
        GreenhouseEnv(**{"bank": bank, **keyword})


def test_difficulties_without_targets_are_refused_at_reset(bank: SceneBank) -> None:
    with pytest.raises(InvalidValueError, match="unreachable"):
        make(bank, difficulty="unreachable").reset(seed=0)


def test_nan_actions_and_early_steps_are_refused(bank: SceneBank) -> None:
    env = make(bank)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(6))
    env.reset(seed=0)
    with pytest.raises(InvalidValueError, match="finite"):
        env.step(np.full(6, np.nan))
    with pytest.raises(InvalidValueError, match="shape"):
        env.step(np.zeros(7))


def test_truth_is_simulated_while_the_reconstruction_is_observed() -> None:
    tip, frame = tool_at(REACH)
    center = tip + 0.03 * frame[:, 2]
    believed = scene_of([Tomato(Sphere(center + [0.0, 0.0, 0.05], 0.03), truss=0)])
    truth = Shapes(tomatoes=(Tomato(Sphere([0.4, 0.9, 1.0], 0.03), truss=1), Tomato(Sphere(center, 0.03), truss=0)))
    placed = believed.model_copy(update={"truth": truth})
    env = make_for(placed, physics="truth")
    observation, info = env.reset(options={"scene": placed, "target": 0, "start": REACH})
    assert info["distance"] == pytest.approx(0.0, abs=1e-6)
    assert observation[26] == pytest.approx(0.05, abs=1e-5)
    assert env.step(np.zeros(6))[4]["is_success"]
    with pytest.raises(InvalidValueError, match="truth"):
        make_for(believed, physics="truth").reset(options={"scene": believed, "target": 0})


def test_the_arm_follows_its_commands_without_ringing() -> None:
    empty = scene_of([Tomato(Sphere([0.0, 5.0, 1.0], 0.03), truss=0)])
    env = make_for(empty, action="joint")
    for joint in range(6):
        for sign in (1.0, -1.0):
            env.reset(options={"scene": empty, "start": "upright"})
            action, trace = np.zeros(6), []
            action[joint] = sign
            for step in range(40):
                *_, info = env.step(action if step < 10 else np.zeros(6))
                trace.append(env.simulation.state)
                assert not info["collision"]
            goal = env.start + 10 * 0.08 * action
            lag = max(np.abs(s.command_error).max() for s in trace)
            assert lag < 0.12
            assert max((sign * (s.joints[0] - goal)[joint]) for s in trace) < 0.005
            np.testing.assert_allclose(trace[-1].joints[0], goal, atol=1e-3)


def test_render_gives_a_picture_only_when_asked(bank: SceneBank) -> None:
    env = make(bank, render_mode="rgb_array")
    env.reset(seed=0)
    env.step(np.zeros(6))
    image = env.render()
    assert image.dtype == np.uint8
    assert image.shape == (480, 640, 3)
    assert image.std() > 20
    assert make(bank).render() is None


def test_importing_the_package_is_light() -> None:
    heavy = "{'open3d', 'torch', 'cv2', 'ompl', 'stable_baselines3', 'mujoco', 'scipy', 'pydantic'}"
    code = f"import sys, greenhouse_gym; print(sorted(set(sys.modules) & {heavy}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_making_an_environment_loads_no_optional_library(bank: SceneBank) -> None:
    code = (
        "import sys, gymnasium, greenhouse_gym\n"
        f"gymnasium.make('TomatoReach-v0', bank={str(bank.path)!r}).reset(seed=0)\n"
        "print(sorted(set(sys.modules) & {'open3d', 'torch', 'cv2', 'ompl', 'stable_baselines3', 'safetensors'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_an_unknown_keyword_is_refused_with_the_ones_that_exist(make: Callable[..., object], bank: SceneBank) -> None:
    with pytest.raises(UnknownKeywordError, match=r"'robots'.*Did you mean 'robot'.*difficulty") as caught:
        make("TomatoReach-v0", bank=bank, robots="ur5e")
    assert isinstance(caught.value, TypeError)
