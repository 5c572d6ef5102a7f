"""The task of harvesting: spaces, checkers, copies, equality of single and vector environments, and errors."""

import copy
import pickle
from importlib import resources

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from greenhouse_gym.agents import Problem
from greenhouse_gym.agents.harvest.harvester import OracleHarvester
from greenhouse_gym.agents.harvest.rehearsal import Rehearsal, RehearsingAgent
from greenhouse_gym.agents.harvest.scan_harvester import ScanHarvester
from greenhouse_gym.agents.harvest.truss_cutter import TrussCutter
from greenhouse_gym.envs import make_env, make_vec_env
from greenhouse_gym.envs.image_observations import RgbObservation
from greenhouse_gym.envs.tasks.harvest import COUNTED, SIZES, TomatoHarvest, ripe_targets
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.rendering.cameras import MAX_RANGE, DepthCamera, scene_from_bases
from greenhouse_gym.scene import SceneBank, Shapes
from greenhouse_gym.scene.plants.layout import Crate, Layout

SCENE = "own-cluster-2000-w00-02"
OPTIONS = {"bank": "mini", "scene": SCENE, **OracleHarvester.env_options}


@pytest.fixture(scope="module")
def env():
    return make_env(**OPTIONS)


def play(env, seed, agent=None, limit=400):
    """Run an episode and return its observations, rewards and last info."""
    agent = agent or OracleHarvester()
    observation, info = env.reset(seed=seed)
    agent.reset(Problem.of(env.simulation, 0, seed, knows_truth=True))
    observations, rewards, over = [observation], [], False
    while not over and len(rewards) < limit:
        observation, reward, terminated, truncated, info = env.step(agent.act(observation))
        observations.append(observation)
        rewards.append(reward)
        over = terminated or truncated
    return np.array(observations), np.array(rewards), info


def test_gymnasium_makes_every_size_with_its_own_step_limit():
    limits = []
    for size in SIZES:
        made = gymnasium.make("TomatoHarvest-v0", size=size, bank="mini")
        limits.append(made.spec.max_episode_steps)
        assert made.action_space.shape == (7,)
        made.close()
    assert limits == [400, 4000, 6000, 18000]
    options = {"task": TomatoHarvest("truss"), "plants": "compliant", "physics": "truth", "bank": "mini"}
    made = gymnasium.make("TomatoReach-v0", **options)
    assert made.spec.max_episode_steps == 4000, "a task as an object"


def test_passes_the_checkers(env):
    check_env(env, skip_render_check=True)


def test_passes_the_checker_of_stable_baselines3(env):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(env)


def test_an_oracle_picks_a_fruit_into_the_crate(env):
    _, rewards, info = play(env, 0)
    assert info["is_success"]
    assert (info["detached"], info["crated"], info["dropped"], info["knocked"]) == (1, 1, 0, 0)
    assert rewards.sum() > 10


def test_the_simulation_repeats_a_rehearsal_bit_for_bit(env):
    env.reset(seed=0)
    problem = Problem.of(env.simulation, 0, 0, knows_truth=True)
    trial = Rehearsal(problem)
    rng = np.random.default_rng(0)
    for _ in range(15):
        trial.step(rng.uniform(-0.1, 0.1, 6), True)
        trial.twin().step(np.full(6, 0.08), True)  # goes its own way
    for action in trial.actions:
        env.step(action)
    np.testing.assert_array_equal(env.simulation.command[0], trial.command)
    np.testing.assert_array_equal(env.simulation.live(0).data.qpos, trial.plants.data.qpos)


def test_same_seed_gives_the_same_episode(env):
    first, second = play(env, 3, limit=120), play(env, 3, limit=120)
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_vector_equals_single_bit_for_bit(env):
    both = make_vec_env(2, **OPTIONS)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (40, 2, 7)).astype(np.float32)
    observations, _ = both.reset(seed=5)
    trace = [observations]
    for action in actions:
        trace.append(both.step(action)[0])
    for i in range(2):
        alone, _ = env.reset(seed=5 + i)
        np.testing.assert_array_equal(alone, trace[0][i])
        for k, action in enumerate(actions):
            alone, _, terminated, _, _ = env.step(action[i])
            np.testing.assert_array_equal(alone, trace[k + 1][i])
            if terminated:
                break


def test_a_copy_goes_on_independently_from_the_same_state(env):
    agent = OracleHarvester()
    observation, _ = env.reset(seed=0)
    agent.reset(Problem.of(env.simulation, 0, 0, knows_truth=True))
    for _ in range(45):
        observation, *_ = env.step(agent.act(observation))
    twin = copy.deepcopy(env)
    action = np.full(7, 0.3, dtype=np.float32)
    ahead = [twin.step(action)[0] for _ in range(10)]
    again = [env.step(action)[0] for _ in range(10)]
    np.testing.assert_array_equal(ahead, again)


def test_a_pickled_environment_begins_the_same_episodes(env):
    other = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(env.reset(seed=2)[0], other.reset(seed=2)[0])


def test_counts_and_reward_terms_are_named(env):
    env.reset(seed=0)
    *_, info = env.step(np.zeros(7))
    assert set(COUNTED) | {"wanted"} <= info.keys()
    assert list(info["reward_terms"]) == [
        "crated", "detached", "dropped", "knocked", "damage", "collision", "progress", "time",
    ]  # fmt: skip


def test_cameras_see_plants_where_they_hang_now():
    camera = DepthCamera("wrist", 32, 24)
    env = make_env(**OPTIONS, observation=RgbObservation(camera, depth=True))
    env.reset(seed=0)
    simulation = env.simulation
    live = simulation.live(0)
    hinges = live.model.jnt_qposadr[live.model.body_jntadr[live.plants.planted.ids.leaf]]
    before, still = (env.step(np.zeros(7, dtype=np.float32))[0]["depth"] for _ in range(2))
    np.testing.assert_array_equal(before, still)
    live.data.qpos[hinges] += 0.5
    seen = env.step(np.zeros(7, dtype=np.float32))[0]["depth"]
    assert (seen != still).mean() > 0.01, "leaves that swing"
    model, data = simulation.model_and_data(0)
    view = scene_from_bases(simulation._perception._frame)[0] @ simulation.state.views[0, 0]
    lengths = np.linalg.norm(camera.rays, axis=1)
    rays = np.ascontiguousarray(camera.rays / lengths[:, None] @ view[:3, :3].T)
    geom, distance = np.empty(len(rays), dtype=np.int32), np.empty(len(rays))
    mujoco.mj_multiRay(
        model, data, view[:3, 3].copy(), rays.reshape(-1), None, True, -1, geom, distance, None, len(rays), 10.0
    )
    depth = np.where(distance >= 0, distance / lengths, 0.0)
    depth[depth > MAX_RANGE] = 0.0
    np.testing.assert_allclose(seen.reshape(-1) * MAX_RANGE, depth, atol=1e-6)
    assert (model.geom_bodyid[geom[geom >= 0]] >= live.plants.planted.ids.truss[0]).any()


def test_a_scan_and_a_camera_suffice_to_pick_a_fruit():
    agent = ScanHarvester()
    env = make_env(bank="mini", scene=SCENE, **agent.env_options)
    observation, info = env.reset(seed=0)
    problem = Problem.of(env.simulation, 0, 0)
    assert problem.rehearsal is None
    agent.reset(problem)
    for _ in range(400):
        observation, _, terminated, _, info = env.step(agent.act(observation))
        if terminated:
            break
    assert info["is_success"]
    assert (info["crated"], info["dropped"]) == (1, 0)


def test_a_scan_harvester_needs_a_harvest():
    env = make_env(bank="mini")
    env.reset(seed=0)
    with pytest.raises(InvalidValueError, match='needs task="harvest"'):
        ScanHarvester().reset(Problem.of(env.simulation, 0, 0))


@pytest.mark.parametrize("agent", [OracleHarvester(), TrussCutter()], ids=lambda agent: agent.name)
def test_an_oracle_needs_plants_that_give_way_and_a_reset(agent: RehearsingAgent):
    env = make_env(bank="mini")
    env.reset(seed=0)
    with pytest.raises(InvalidValueError, match=r'needs task=.* with plants="compliant"'):
        agent.reset(Problem.of(env.simulation, 0, 0))
    with pytest.raises(RuntimeError, match="reset the agent"):
        agent.act(None)


def test_a_problem_names_the_fruit_that_the_scan_shows():
    stand = make_env(**OPTIONS, size="stand")
    stand.reset(seed=0)
    shown = ripe_targets(SceneBank.open("mini").scene(SCENE), 0.6)
    targets = Problem.of(stand.simulation, 0, 0).targets
    assert {shown[k] for k in targets} == set(stand.simulation.episode(0).fruit)


def test_rigid_plants_are_refused():
    with pytest.raises(InvalidValueError, match='needs plants="compliant"'):
        make_env(bank="mini", task="harvest")


def test_compliance_without_truth_is_refused():
    with pytest.raises(InvalidValueError, match='plants="compliant" needs physics="truth"'):
        make_env(bank="mini", plants="compliant")


def test_a_scene_without_truth_is_refused():
    bare = SceneBank.open("mini").scene(SCENE).model_copy(update={"truth": None})
    with pytest.raises(InvalidValueError, match="carries no truth"):
        make_env(**OPTIONS | {"scene": bare}).reset(seed=0)


def test_truth_without_stems_is_refused():
    scene = SceneBank.open("mini").scene(SCENE)
    truth = Shapes(tomatoes=scene.truth.tomatoes, clutter=scene.truth.clutter)
    with pytest.raises(InvalidValueError, match="has no topology"):
        make_env(**OPTIONS | {"scene": scene.model_copy(update={"truth": truth})}).reset(seed=0)


def test_more_fruit_than_slots_are_refused():
    task = TomatoHarvest("truss", layout=Layout(trusses=1, fruit=1))
    scene = SceneBank.open("mini").scene(SCENE)
    trusses = {tomato: scene.truth.tomatoes[fruit].truss for tomato, fruit in ripe_targets(scene, 0.6).items()}
    target = next(k for k, truss in trusses.items() if list(trusses.values()).count(truss) > 1)
    with pytest.raises(InvalidValueError, match="do not fit into slots of 1"):
        make_env(**OPTIONS | {"task": task, "target": target}).reset(seed=0)


def test_a_crate_in_the_way_of_the_arm_is_refused():
    task = TomatoHarvest(layout=Layout(crate=Crate(position=(0.0, 0.0, 0.9), half_extents=(0.3, 0.3, 0.2))))
    with pytest.raises(InvalidValueError, match="crate is in the arm's way"):
        make_env(**OPTIONS | {"task": task}).reset(seed=0)


def test_an_arm_whose_gripper_cannot_hold_is_refused(tmp_path):
    arm = tmp_path / "arm.xml"
    arm.write_text((resources.files("greenhouse_gym.robots") / "ur5e.xml").read_text().replace('"cup"', '"finger"'))
    with pytest.raises(InvalidValueError, match="has no gripper that can hold"):
        make_env(**OPTIONS, robot=arm).reset(seed=0)


def test_a_size_of_another_task_is_refused():
    with pytest.raises(InvalidValueError, match='size belongs to task="harvest"'):
        make_env(bank="mini", size="pick")
