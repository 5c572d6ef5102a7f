"""Agents get what their track allows, and nothing else can be reached from it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from types import BuiltinFunctionType, ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest
from gymnasium import spaces

from greenhouse_gym.agents import Problem
from greenhouse_gym.envs import GreenhouseEnv, State, make_env
from greenhouse_gym.envs.episodes import Episode, EpisodeSampler
from greenhouse_gym.envs.simulation import Simulation
from greenhouse_gym.envs.world import World
from greenhouse_gym.envs.worlds import Worlds
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.evaluation.leaderboard import TRACKS
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene.obstacles import Shapes
from greenhouse_gym.scene.truth import known_scene

BANK = SceneBank.open("mini")
ANSWERS = (
    Target, Simulation, World, Worlds, SceneBank, Episode, EpisodeSampler, GreenhouseEnv, mujoco.MjModel, mujoco.MjData,
)  # fmt: skip
ENDS = (str, bytes, int, float, bool, complex, type(None), type, ModuleType, BuiltinFunctionType, np.generic, np.dtype)


def neighbors(thing: Any) -> Iterator[Any]:
    """Everything that one step leads to: attributes, items, what methods and functions hold, what views are of."""
    if isinstance(thing, Mapping):
        yield from [*thing, *thing.values()]
    elif isinstance(thing, list | tuple | set | frozenset):
        yield from thing
    elif isinstance(thing, np.ndarray):
        yield thing.base
        return
    for cell in getattr(thing, "__closure__", None) or ():
        yield cell.cell_contents
    for name in dir(thing):
        if name not in ("__globals__", "__builtins__", "__class__", "__doc__") and "deprecated" not in name:
            try:
                yield getattr(thing, name)
            except Exception:  # not to be had
                continue


def reachable(roots: Iterable[Any], limit: int = 60_000) -> list[Any]:
    found: dict[int, Any] = {}
    stack = list(roots)
    while stack and len(found) < limit:
        thing = stack.pop()
        if id(thing) in found:
            continue
        found[id(thing)] = thing
        if not isinstance(thing, ENDS) and not (callable(thing) and not hasattr(thing, "__closure__")):
            stack += neighbors(thing)
    return list(found.values())


def holds(array: Any, point: np.ndarray) -> bool:
    """Return whether the coordinates of a point are among the numbers of an array."""
    if array.dtype.kind != "f" or array.size < len(point):
        return False
    windows = np.lib.stride_tricks.sliding_window_view(np.ravel(array), len(point))
    return bool((np.abs(windows - point) < 1e-7).all(axis=-1).any())


class Snoop:
    """An agent with an observation and an action of its own, which look at all that they get."""

    name = "snoop"

    def __init__(self) -> None:
        self.got: list[Any] = []
        self.states: list[State] = []
        self.problem: Problem | None = None
        self.env_options = {"observation": self.observe, "action": self.moves}

    def observe(self, robot: Robot) -> Any:
        got, states = self.got, self.states
        got.append(robot)

        class Seen:
            space = spaces.Box(-1, 1, (1,), np.float32)

            def __call__(self, state: State) -> np.ndarray:
                got.append(state)
                states.append(state)
                for values in (state.goal, state.success, state.collided, state.distance):
                    values[:] = 1  # as if it were there
                return np.zeros((len(state.joints), 1), np.float32)

        return Seen()

    def moves(self, robot: Robot, interval: float) -> Any:
        got = self.got

        class Still:
            space = spaces.Box(-1, 1, (6,), np.float32)
            peak = np.full(6, 1e-9)  # a lie

            def __call__(self, action: Any, state: State, motion: Any) -> np.ndarray:
                got.extend([action, state, motion])
                state.success[:] = True
                return np.full((len(action), 6), 0.5)

        return Still()

    def reset(self, problem: Problem) -> None:
        self.problem = problem
        self.got.append(problem)

    def act(self, observation: Any) -> np.ndarray:
        self.got.append(observation)
        if len(self.got) > 20:
            raise RuntimeError("seen enough")
        return np.zeros(6)


@pytest.mark.filterwarnings("ignore")  # of attributes that are going out of use
@pytest.mark.parametrize("track", ["reconstruction", "truth", "moved", "brush"])
def test_an_agent_that_looks_at_everything_finds_no_answer(track: str) -> None:
    agent = Snoop()
    (record,) = evaluate(agent, "validation", 1, bank="mini", progress=False, **TRACKS[track]).records
    assert not record.success, "saying so makes no success"
    assert agent.problem is not None
    scene = BANK.scene(record.scene)
    assert scene.truth is not None
    things = reachable([*agent.got, *agent.problem.scene.arrays])  # the last first
    assert len(things) > 1000
    for thing in things:
        assert not isinstance(thing, ANSWERS), thing
        if isinstance(thing, Scene):
            assert thing.truth is None
            assert not thing.targets
        elif isinstance(thing, Shapes):
            assert len(thing.obstacles) != len(scene.truth.obstacles)
        elif isinstance(thing, str):
            assert scene.name not in thing
            assert scene.provenance.row not in thing
    arrays = [thing for thing in things if isinstance(thing, np.ndarray)]
    true = [tomato.center for tomato in scene.truth.tomatoes]
    ways = [np.ravel(target.witness[-2:]) for target in scene.targets if target.witness]
    with_goal = make_env(bank="mini", split="validation", **TRACKS[track])
    with_goal.reset(seed=0)
    state = with_goal.simulation.state
    assert state is not None
    hidden = [] if track == "reconstruction" else [state.goal[0]]
    assert ways
    for answer in [*true, *ways, *hidden]:
        assert not any(holds(array, np.asarray(answer)) for array in arrays)
    assert any(holds(array, scene.tomatoes[record.target].center) for array in arrays), "what it may know is there"


def test_what_is_known_of_a_scene_is_enough_to_act_in_it() -> None:
    scene = BANK.scene(BANK.names("validation")[0])
    known = known_scene(scene)
    assert known.columns is scene.columns
    assert known.placement is scene.placement
    assert known.occupancy is scene.occupancy
    assert (known.truth, known.targets) == (None, ())
    assert known.provenance.settings == scene.provenance.settings
    assert known.provenance.protocol == scene.provenance.protocol
    assert not any(word in known.provenance.model_dump_json() for word in (scene.name, scene.provenance.row))


def test_an_agent_cannot_change_the_rules_by_what_it_gets() -> None:
    env = make_env(bank="mini", split="validation", action="joint")
    env.reset(seed=0)
    simulation = env.simulation
    problem = Problem.of(simulation, 0, 0)
    problem.start[:] += 1.0
    problem.action_space.high[:] = 100.0
    problem.joint_steps[:] *= 100.0
    assert np.array_equal(simulation.episode(0).start, get_robot("ur5e").start)
    before = simulation.command.copy()
    env.step(np.full(6, 100.0, dtype=np.float32))
    assert np.abs(simulation.command - before).max() < 0.0801


def test_a_rule_that_lies_about_its_largest_change_keeps_the_speed_limit() -> None:
    env = make_env(bank="mini", split="validation", action=Snoop().moves)
    env.reset(seed=0)
    before = env.simulation.command.copy()
    env.step(np.zeros(6, dtype=np.float32))
    robot = env.simulation.robot
    assert (np.abs(env.simulation.command - before) <= robot.velocity_limits * env.simulation.interval + 1e-9).all()
