"""The protocol of agents: an agent gets the problem at the start of an episode and then acts on observations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.common.own_code import described
from greenhouse_gym.envs.actions import (
    INTERVAL,
    ActionRule,
    JointIncrements,
    JointVelocities,
    TipVelocity,
    ToolMotion,
    with_controls,
)
from greenhouse_gym.envs.choices import make_action
from greenhouse_gym.envs.compliant_physics import CompliantPhysics
from greenhouse_gym.envs.simulation import Simulation
from greenhouse_gym.envs.state import STEP_LIMIT, State
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import CompiledScene, Scene, compile_scene
from greenhouse_gym.scene.plants.layout import Crate


@dataclass(frozen=True, eq=False)
class Problem:
    """Knowledge of an agent at the start of an episode.

    Attributes:
        scene: The reconstructed scene; see `greenhouse_gym.scene.truth.known_scene`.
        target: Index of the target tomato in the scene.
        robot: The arm.
        start: (joints,) start configuration, radians.
        seed: Seed of the agent's random choices in this episode.
        action: The environment's action rule; joint increments if None.
        interval: Seconds between two actions.
        step_limit: Number of actions after which the episode ends.
        controls: Names of the entries that an action has after those that move the arm, see `Task.controls`.
        rehearsal: Function that copies the simulation with its compliant plants, for agents with ``knows_truth`` alone.
        plants: "rigid", or "brush" if leaves give way, see `greenhouse_gym.envs.EnvSettings`.
        targets: Indices of all targets of the episode in the scene; a harvest's are the fruit to be picked that the
            scan shows.
        crate: Crate of a harvest.
    """

    scene: Scene
    target: int
    robot: Robot
    start: Array
    seed: int = 0
    action: ActionRule | None = None
    interval: float = INTERVAL
    step_limit: int = STEP_LIMIT
    controls: tuple[str, ...] = ()
    rehearsal: Callable[[], CompliantPhysics] | None = None
    plants: str = "rigid"
    targets: tuple[int, ...] = ()
    crate: Crate | None = None

    @classmethod
    def of(cls, simulation: Simulation, i: int, seed: int, knows_truth: bool = False) -> Problem:
        """Return the problem of the current episode of a simulation.

        It shares no object with the simulation that an agent could read the truth from or change the rules by, unless
        the agent declares that it ``knows_truth`` and the plants are compliant.
        """
        settings, robot, interval = simulation.settings, simulation.robot, simulation.interval
        return cls(
            simulation.known_scene(i), simulation.target(i), robot, simulation.episode(i).start.copy(), seed,
            make_action(settings.action, robot, interval), interval, simulation.step_limit, simulation.task.controls,
            partial(simulation.rehearsal, i) if knows_truth and settings.plants == "compliant" else None,
            settings.plants, simulation.episode(i).targets,
            None if simulation.task.layout is None else simulation.task.layout.crate,
        )  # fmt: skip

    @cached_property
    def compiled(self) -> CompiledScene:
        """The scene with the arm."""
        return compile_scene(self.scene, self.robot)

    def later(self, known: CompiledScene, start: Array) -> Problem:
        """Return the problem of an arm that has come to rest at ``start`` in the scene as it is known by now."""
        assert isinstance(known.scene, Scene)
        result = replace(self, scene=known.scene, start=start)
        result.__dict__["compiled"] = known
        return result

    @property
    def action_space(self) -> spaces.Box:
        """Space of an action; it has one axis."""
        return with_controls(self.rule.space, self.controls)

    @property
    def joint_steps(self) -> Array:
        """Change of each joint's command by an action of 1, (joints,) radians.

        Raises:
            InvalidValueError: The environment's actions do not move the joints.
        """
        rule = self.rule
        if not isinstance(rule, JointIncrements | JointVelocities):
            raise InvalidValueError(
                f"a joint path can be followed with action='joint' or 'joint_velocity' only, got {type(rule).__name__}"
            )
        return rule.peak

    def command_change(self, action: Array, motion: ToolMotion) -> Array:
        """Return the change of the joints' commands by an action (size,), (joints,) radians, before limits.

        Args:
            action: The action.
            motion: Kinematics of the tool of one arm.

        Raises:
            InvalidValueError: The environment has its own kind of action, which may read the whole state.
        """
        rule = self.rule
        if not isinstance(rule, JointIncrements | JointVelocities | TipVelocity):
            raise InvalidValueError(f"the effect of an action is known for the package's own only, not {rule!r}")
        return rule(action[None], cast(State, None), motion)[0]

    @property
    def rule(self) -> ActionRule:
        """Kind of action that the environment takes."""
        return JointIncrements(self.robot, self.interval) if self.action is None else self.action


@runtime_checkable
class Agent(Protocol):
    """A reaching agent, scripted, planned or learned.

    An agent without memory may also have a method ``act_many(observations)`` that returns actions (n, size) for the
    observations of n simulations. It is called when many episodes run side by side; of any other agent, every
    simulation gets a copy.

    An agent whose observation has images may have an attribute ``reads_images``, which is read after each action: where
    it is False, the images of the next observation are zero and cost no time. A new episode begins with images.

    Attributes:
        name: Its name in tables.
        env_options: Keywords of `gymnasium.make` for the environment that the agent needs. A keyword ``action`` of the
            user replaces that of an agent with an attribute ``takes_other_actions = True``.
    """

    name: str
    env_options: Mapping[str, Any]

    def reset(self, problem: Problem) -> None:
        """Prepare for an episode."""

    def act(self, observation: Any) -> npt.NDArray[np.floating[Any]]:
        """Return the next action (size,) in `Problem.action_space`: [-1, 1] unless the environment has its own."""


def knows_truth(agent: Agent) -> bool:
    """Return whether an agent declares that it ``knows_truth``, and so gets more than a robot could know."""
    return bool(getattr(agent, "knows_truth", False))


def knows_scene(agent: Agent) -> bool:
    """Return whether an agent may use the whole reconstruction; False if it declares that it acts on its observation.

    The leaderboard keeps both kinds apart. The observation of such an agent holds no plan.
    """
    return bool(getattr(agent, "knows_scene", True))


def reads_images(agent: Agent) -> bool:
    """Return whether an agent reads the images of its next observation; False if it declares that it does not."""
    return bool(getattr(agent, "reads_images", True))


class NamedAgent:
    """Base of agents that gives them a short text."""

    name: str

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r})"


class JointAgent(NamedAgent):
    """Base of agents that move the joints: their environment has joint actions, unless its user chooses others."""

    takes_other_actions = True
    env_options: Mapping[str, Any] = MappingProxyType({"action": "joint"})


def check_agent(agent: object) -> None:
    """Raise an error unless an object is an `Agent`.

    Raises:
        InvalidValueError: It is a class, or lacks an attribute of an agent.
    """
    if isinstance(agent, type):
        raise InvalidValueError(f"{agent.__name__} is a class: an agent is an object, such as {agent.__name__}()")
    kinds: dict[str, Callable[[object], bool]] = {
        "name": lambda value: isinstance(value, str),
        "env_options": lambda value: isinstance(value, Mapping),
        "reset": callable,
        "act": callable,
    }
    found: dict[str, object] = {}
    for attribute in kinds:
        try:
            found[attribute] = getattr(agent, attribute, None)
        except KeyboardInterrupt:
            raise
        except BaseException:  # of its own code: the attribute exists; its error is raised where it is needed
            continue
    for attribute, value in found.items():
        if not kinds[attribute](value):
            called = found.get("name") if isinstance(found.get("name"), str) else type(agent).__name__
            raise InvalidValueError(
                f"{called!r} is no agent: its {attribute!r} is missing or of the wrong type; an agent has a name, "
                "env_options (a mapping), reset(problem) and act(observation)"
            )


def takes_other_actions(agent: Agent) -> bool:
    """Return whether an agent declares that it ``takes_other_actions`` than those of its ``env_options``."""
    return bool(getattr(agent, "takes_other_actions", False))


def own_options(agent: Agent, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keywords that an agent chooses for an environment that also gets those of ``options``."""
    replaced = {"action"} & options.keys() if takes_other_actions(agent) else set()
    return {key: value for key, value in agent.env_options.items() if key not in replaced}


def options_for(agent: Agent, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keywords of an agent's environment: its own, and further ones that do not contradict them.

    Raises:
        InvalidValueError: They contradict each other.
    """
    own = own_options(agent, options)
    for key, value in own.items():
        if key in options and described(options[key]) != described(value):
            raise InvalidValueError(f"agent {agent.name!r} needs {key}={value!r}, got {options[key]!r}")
    return {**options, **own}


def action_towards(waypoint: Array, command: Array, steps: Array) -> Array:
    """Return the action (joints,) in [-1, 1] that moves straight towards a waypoint at full speed.

    Args:
        waypoint: (joints,) radians.
        command: (joints,) current command, radians.
        steps: (joints,) what an action of 1 adds to the command, radians; see `Problem.joint_steps`.
    """
    wish = (waypoint - command) / steps
    return np.asarray(wish / max(1.0, float(np.abs(wish).max())))
