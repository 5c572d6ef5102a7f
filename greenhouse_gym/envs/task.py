"""Protocol of tasks: goal and outcome of episodes, independent of physics, sensors, agents and evaluation.

A task is one class, usually in one file, see `greenhouse_gym.envs.tasks.reach`. Its methods are elementwise functions
of arrays over n simulations, so the vector environment and single environments compute the same numbers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.contacts import CONTACT_GROUPS
from greenhouse_gym.envs.episodes import Episode, EpisodeSampler
from greenhouse_gym.envs.features import FEATURES, Feature
from greenhouse_gym.envs.rewards import REWARDS, Reward
from greenhouse_gym.envs.state import STEP_LIMIT, Bools, State
from greenhouse_gym.geometry import Array
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.scene.plants.layout import Layout
from greenhouse_gym.scene.plants.mechanics import PlantMechanics

if TYPE_CHECKING:
    from greenhouse_gym.envs.views import View
    from greenhouse_gym.envs.world import World

TARGET_FEATURES = ("grasp_offset", "target_position", "target_direction", "turn_to_target")
"""Features of a task with one target at a time, see `GreenhouseEnv`."""


class Outcome(NamedTuple):
    """Outcome of a task in n simulations.

    Attributes:
        distance: (n,) remaining distance to the goal, metres. Rewards for progress read it.
        success: (n,) whether the task is solved, which ends the episode.
        failure: (n,) whether the task has failed, which ends the episode.
        next_target: (n,) whether the current target is done and the next one of the episode follows; None for tasks
            with one target.
        memory: New values (n, ...) of `Task.memory`.
    """

    distance: Array
    success: Bools
    failure: Bools
    next_target: Bools | None = None
    memory: Mapping[str, Array] = MappingProxyType({})


class Task(ABC):
    """Task of an environment. Subclass it, and pass the class, an object or ``"file.py:Name"`` as ``task=``.

    Attributes:
        ends_on: Contact groups that end an episode as a collision; by default all `CONTACT_GROUPS`. Contacts of the
            other groups are counted in ``info["contacts"]`` and `State.contacts`.
        costs: Reward per contact and physics step by group, such as ``{"leaf": -0.02}``; the sum is the reward term
            ``contact``.
        brush_cost: Reward per second in which a leaf is touched, the reward term ``brush``, with ``plants="brush"``.
            Leaves then end no episode, whatever ``ends_on`` says.
        features: Groups of numbers that observations contain about the task, by name.
        rewards: Rewards by name, for the setting ``reward``.
        memory: Numbers and arrays that each simulation remembers from step to step, by name with their initial values.
            They are in `State.memory`; numbers are also in ``info`` and in the records of an evaluation. A name that
            begins with an underscore is known to the task and its rewards alone.
        arrays: Spaces of arrays in `memory` that ``observation="task"`` contains, by name.
        controls: Names of the entries, from -1 to 1, that an action has after those that move the arm.
        camera: Camera that takes the views for `see`; None for no views.
        allows_cup_contact: The cup may touch the targets of the episode.
        layout: Slots for plants that give way, for a task that needs them; None for one that works with any plants.
        mechanics: Mechanics of plants that give way.
        step_limit: Steps after which an episode is truncated, unless the environment's setting says otherwise.
        knows_scan: Agents know the scanned scene at the start of an episode; otherwise only where the arm stands.
    """

    ends_on: Collection[str] = CONTACT_GROUPS
    costs: Mapping[str, float] = MappingProxyType({})
    brush_cost: float = -0.4
    features: Mapping[str, Feature] = MappingProxyType({name: FEATURES[name] for name in TARGET_FEATURES})
    rewards: Mapping[str, Reward] = REWARDS
    memory: Mapping[str, npt.ArrayLike] = MappingProxyType({})
    arrays: Mapping[str, spaces.Box] = MappingProxyType({})
    controls: tuple[str, ...] = ()
    camera: DepthCamera | None = None
    allows_cup_contact: bool = True
    layout: Layout | None = None
    mechanics: PlantMechanics = PlantMechanics()
    step_limit: int = STEP_LIMIT
    knows_scan: bool = True

    def sample(self, sampler: EpisodeSampler, rng: np.random.Generator, options: Mapping[str, Any] | None) -> Episode:
        """Draw an episode: a scene, one or several targets in order, and a start configuration.

        Args:
            sampler: Draws scenes and targets from the bank by the environment's settings.
            rng: Generator of the simulation.
            options: Options of the reset.
        """
        return sampler.draw(rng, options)

    def begin(self, world: World) -> Mapping[str, npt.ArrayLike]:
        """Return the initial values of `memory` in a simulated world, with the shapes of those in `memory`."""
        return self.memory

    def looks(self, controls: Array) -> Bools:
        """Return a mask (n,) of the simulations that take a view after an action with these `controls` (n, c)."""
        return np.zeros(len(controls), dtype=np.bool_)

    def holds(self, controls: Array) -> Bools:
        """Return a mask (n,) of the simulations whose vacuum is on in an action with these entries of `controls`."""
        return np.zeros(len(controls), dtype=np.bool_)

    def see(self, view: View, memory: Mapping[str, Any]) -> Mapping[str, npt.ArrayLike]:
        """Return new values of those entries of `memory` that a view of one simulation changes."""
        return {}

    @abstractmethod
    def evaluate(self, state: State) -> Outcome:
        """Return the outcome of n simulations.

        Args:
            state: State after a reset or an action. Its ``memory`` holds the values before, and its ``distance``,
                ``success`` and ``failure`` are not known yet.
        """


class GoalTask(Task):
    """Task whose outcome depends only on an achieved and a desired goal, points (n, 3), and on collisions.

    Goal environments need one, because hindsight replay evaluates steps with other goals.
    """

    @abstractmethod
    def goals(self, state: State) -> tuple[Array, Array]:
        """Return the achieved and desired goals (n, 3) of n simulations, metres in the base frame."""

    @abstractmethod
    def evaluate_goals(self, achieved: Array, desired: Array, collided: Bools) -> Outcome:
        """Return the outcome for achieved and desired goals (n, 3), and whether a contact ended the episode (n,)."""

    def evaluate(self, state: State) -> Outcome:
        """Return the outcome of n simulations."""
        return self.evaluate_goals(*self.goals(state), state.collided)
