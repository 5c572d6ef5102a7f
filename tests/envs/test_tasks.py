"""Tasks: the protocol, contact groups, and the examples in every kind of environment."""

from __future__ import annotations

import runpy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from test_vector import compare_with_singles

from greenhouse_gym.agents import RandomAgent, StraightLineAgent
from greenhouse_gym.crops.parts import is_leaf
from greenhouse_gym.envs import CONTACT_GROUPS, GoalTask, GreenhouseEnv, GreenhouseVectorEnv, Outcome, State, Task
from greenhouse_gym.envs.contacts import geom_groups
from greenhouse_gym.envs.physics import Physics
from greenhouse_gym.envs.tasks import TASKS, TomatoReach
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError
from greenhouse_gym.evaluation import compare, evaluate
from greenhouse_gym.evaluation.journal import RecordJournal
from greenhouse_gym.scene import SceneBank, compile_scene

EXAMPLES = Path(__file__).parents[2] / "examples"
LOOK, THREE = f"{EXAMPLES}/own_task.py:LookAtTomato", f"{EXAMPLES}/three_tomatoes.py:ThreeTomatoes"


class Touch(TomatoReach):
    """Reaching that no contact ends, and in which each contact with a leaf costs."""

    ends_on = ()
    costs: Mapping[str, float] = {"leaf": -0.5, "self": -0.25}


def drifting(count: int, seed: int = 0) -> Any:
    """Actions (count, 6) that keep their direction for 20 steps, which is far enough to touch plants."""
    rng = np.random.default_rng(seed)
    drifts = rng.uniform(-1, 1, (40, count, 6)).astype(np.float32)
    return lambda step: drifts[step // 20 % len(drifts)]


@pytest.mark.parametrize("task", [LOOK, THREE, Touch])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_own_tasks_give_the_same_in_vector_and_single(task: Any, mode: str) -> None:
    keywords = {"bank": "mini", "task": task, "step_limit": 60}
    assert compare_with_singles(3, 130, drifting(3), mode, **keywords) >= 6


def test_examples_run(capsys: pytest.CaptureFixture[str]) -> None:
    for name, env_id in (("own_task", "LookAtTomato-v0"), ("three_tomatoes", "ThreeTomatoes-v0")):
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        assert "| straight-line |" in capsys.readouterr().out
        check_env(gymnasium.make(env_id, bank="mini").unwrapped, skip_render_check=True)
        assert gymnasium.make_vec(env_id, num_envs=2, bank="mini").unwrapped.num_envs == 2


def test_an_own_task_is_learned_evaluated_and_compared(bank: SceneBank, tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO

    from greenhouse_gym.learning.sb3 import Sb3Agent, make_sb3_vec_env

    env = make_sb3_vec_env(2, bank=bank, task=THREE, seed=0)
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, device="cpu").learn(64)
    agent = Sb3Agent(model)
    assert agent.env_options["task"] == THREE
    journal = RecordJournal(tmp_path / "records.jsonl", {"task": THREE})
    found = evaluate(agent, episodes=3, bank=bank, num_envs=2, journal=journal)
    assert RecordJournal(tmp_path / "records.jsonl", {"task": THREE}).records[0] == found.records[0]
    assert all(0 <= record.measures["touched"] <= 3 for record in found.records)
    both = compare([agent, RandomAgent()], episodes=3, bank=bank, task=THREE)
    assert [record.scene for record in both[0].records] == [record.scene for record in both[1].records]


def test_targets_follow_one_another(bank: SceneBank) -> None:
    """Three targets at which the tool already is are done in three steps; the last one is the success."""

    class Near(TASKS["reach"]):  # type: ignore[misc]
        def sample(self, sampler: Any, rng: np.random.Generator, options: Any) -> Any:
            from dataclasses import replace

            return replace(sampler.draw(rng, options), targets=(0, 1, 0))

        def evaluate(self, state: State) -> Outcome:
            outcome = super().evaluate(state)
            near = outcome.distance < 10.0
            return outcome._replace(success=near & (state.remaining == 1), next_target=near)

    env = GreenhouseEnv(bank=bank, task=Near())
    observation, info = env.reset(seed=0)
    scene, targets, ends = env.scene, [env.target], []
    for _ in range(3):
        observation, _, terminated, _, info = env.step(np.zeros(6))
        targets.append(env.target)
        ends.append((terminated, info["is_success"], info["target"]))
        center = observation[27:30] + env.simulation._setup(0).world.frame[:3]
        if env.simulation._setup(0).world.frame[3] == 1.0:
            np.testing.assert_allclose(center, scene.tomatoes[env.target].center, atol=1e-5)
    assert targets == [0, 1, 0, 0]
    assert ends == [(False, False, 1), (False, False, 0), (True, True, 0)]


def test_groups_are_those_of_the_names() -> None:
    for scene in map(SceneBank.open("mini").scene, SceneBank.open("mini").names()):
        compiled = compile_scene(scene, "ur5e", 900)
        world = int(compiled.model.body_geomnum[0])
        for geom, group in enumerate(geom_groups(compiled)):
            name = compiled.geom_name(geom)
            kind, expected = name.split("_"), "self"
            if geom < world:
                expected = {"tomato": "fruit", "clutter": "leaf", "stem": "stem"}.get(kind[0], "fixture")
                expected = "fixture" if kind[-1] in ("pipe", "string") else expected
                if kind[0] == "clutter" and not is_leaf(scene.clutter[int(kind[1])]):
                    expected = "fixture"  # a gutter
            assert CONTACT_GROUPS[group] == expected, name


@pytest.mark.parametrize("count", [1, 3])
def test_contacts_are_counted_in_every_physics_step_while_the_arm_stays_in_contact(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Counts come from a repetition of the action, which ends exactly where the simulation does."""
    repeated, repeat = [], Physics._repeat

    def recorded(self: Physics, i: int, *arguments: Any) -> Any:
        result = repeat(self, i, *arguments)
        repeated.append((i, self._data.qpos.copy(), self._data.qvel.copy()))
        return result

    monkeypatch.setattr(Physics, "_repeat", recorded)
    env = GreenhouseVectorEnv(count, bank="mini", task=Touch, step_limit=10_000, threads=1)
    env.reset(seed=1)
    actions, seen = drifting(count, 3), np.zeros(len(CONTACT_GROUPS), dtype=int)
    for step in range(300):
        repeated.clear()
        _, reward, terminated, _, infos = env.step(actions(step))
        assert not terminated.any()
        counts = infos["contacts"]
        terms = infos["reward_terms"]
        np.testing.assert_array_equal(terms["contact"], -0.5 * counts["leaf"] - 0.25 * counts["self"])
        names = ("success", "collision", "progress", "time", "effort", "contact")
        np.testing.assert_allclose(reward, sum(terms[name] for name in names))
        seen += [counts[group].sum() for group in CONTACT_GROUPS]
        assert {i for i, *_ in repeated} >= set(np.flatnonzero(sum(counts[group] for group in CONTACT_GROUPS)))
        for i, joints, velocities in repeated:
            np.testing.assert_array_equal(joints, env.simulation.joints[i])
            np.testing.assert_array_equal(velocities, env.simulation._physics.qvel[i])
    assert seen.sum() > 500
    assert count == 1 or (seen > 0).sum() >= 4, dict(zip(CONTACT_GROUPS, seen, strict=True))


def test_a_group_that_does_not_end_the_episode_is_no_collision() -> None:
    """The same motion with and without leaves that end it: equal until the first leaf is touched."""

    class Brush(TomatoReach):
        ends_on = ("fruit", "stem", "fixture", "self")

    keywords = {"bank": "mini", "autoreset_mode": "SameStep"}
    strict, brush = (GreenhouseVectorEnv(16, task=task, **keywords) for task in (TomatoReach, Brush))
    strict.reset(seed=0)
    brush.reset(seed=0)
    actions, running, leaves = drifting(16, 5), np.ones(16, dtype=bool), 0
    for step in range(150):
        one, two = (env.step(actions(step)) for env in (strict, brush))
        np.testing.assert_array_equal(one[0][running & ~one[2]], two[0][running & ~one[2]])
        for i in np.flatnonzero(running & one[2]):
            final = one[4]["final_info"]
            only_leaf = final["contact"][i].split(", ")[1].startswith("clutter_")
            leaves += only_leaf
            if not two[2][i]:
                assert only_leaf
                assert not two[4]["collision"][i]
                assert two[4]["contacts"]["leaf"][i] > 0
        running &= ~one[2]
    assert leaves > 1


def test_hindsight_pays_for_contacts_as_the_step_did() -> None:
    env = GreenhouseEnv(bank="mini", task=Touch, observation="goal", step_limit=1000)
    seen, _ = env.reset(seed=1)
    actions, paid = drifting(1, 3), 0.0
    for step in range(200):
        seen, reward, terminated, _, info = env.step(actions(step)[0])
        assert env.compute_reward(seen["achieved_goal"], seen["desired_goal"], info) == reward
        assert env.compute_terminated(seen["achieved_goal"], seen["desired_goal"], info) == terminated
        paid += info["reward_terms"]["contact"]
    assert paid < 0


class Wrong(Task):
    def __init__(self, **values: Any):
        self.values = values

    def evaluate(self, state: State) -> Outcome:
        n = len(state.joints)
        usual = {"distance": np.ones(n), "success": np.zeros(n, dtype=bool), "failure": np.zeros(n, dtype=bool)}
        return Outcome(**{**usual, **self.values})


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (Wrong(distance=np.zeros(2)), r"task Wrong, distance must return numbers of shape \(1,\)"),
        (Wrong(distance=np.array([np.nan])), r"task Wrong, distance must be finite"),
        (Wrong(success=np.zeros(1)), r"task Wrong, success must be bool, got float64"),
        (Wrong(next_target=np.zeros(1)), r"task Wrong, next_target must be bool"),
        (Wrong(memory={"seen": np.zeros(1)}), r"task Wrong, memory must have .*, got 'seen'"),
        (type("No", (Task,), {"evaluate": lambda self, state: 3})(), r"task No must return an Outcome, got 3"),
    ],
)
def test_mistakes_in_an_outcome_are_reported(bank: SceneBank, task: Task, message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        GreenhouseEnv(bank=bank, task=task).reset(seed=0)


def test_what_is_not_a_task_is_rejected(bank: SceneBank, tmp_path: Path) -> None:
    for task in (3, None, object):
        with pytest.raises(InvalidValueError, match="task must be a name, a Task or a subclass"):
            GreenhouseEnv(bank=bank, task=task)
    with pytest.raises(UnknownNameError, match="reach"):
        GreenhouseEnv(bank=bank, task="reech")
    with pytest.raises(UnknownNameError, match="LookAtTomato"):
        GreenhouseEnv(bank=bank, task=LOOK[:-1])
    with pytest.raises(FileFormatError, match="there is no such file; expected Python code with the task"):
        GreenhouseEnv(bank=bank, task=f"{tmp_path}/none.py:Name")
    with pytest.raises(UnknownNameError, match="leaf"):
        GreenhouseEnv(bank=bank, task=type("Typo", (Touch,), {"costs": {"leave": -1.0}}))
    with pytest.raises(InvalidValueError, match="needs a GoalTask, got the task LookAtTomato"):
        GreenhouseEnv(bank=bank, task=LOOK, observation="goal")
    assert issubclass(TomatoReach, GoalTask)


def test_success_has_one_formula(bank: SceneBank) -> None:
    """The environment, hindsight and evaluation report the outcome of the task."""
    env = GreenhouseEnv(bank=bank, observation="goal", success_radius=0.5)
    assert env.simulation.task == TomatoReach(0.5)
    agent, reached = StraightLineAgent(), 0
    for record in evaluate(agent, episodes=6, bank=bank, success_radius=0.5).records:
        assert record.success == (record.distance < 0.5 and not record.collision)
        reached += record.success
    assert reached > 0
