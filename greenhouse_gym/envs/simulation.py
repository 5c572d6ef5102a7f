"""Batch of n simulations of a task: the core of both environments."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.progress import progress
from greenhouse_gym.envs.actions import CommandLimits, check_actions, squared_norm, with_controls
from greenhouse_gym.envs.checked_parts import OwnPart, outcome_check, remembered
from greenhouse_gym.envs.choices import make_action, make_observation, make_reward, make_task
from greenhouse_gym.envs.compliant_physics import CompliantPhysics
from greenhouse_gym.envs.compliant_simulation import CompliantSimulation
from greenhouse_gym.envs.contacts import Contacts
from greenhouse_gym.envs.episode_counts import EpisodeCounts
from greenhouse_gym.envs.episodes import LARGEST_COMPLIANT, Episode, EpisodeSampler
from greenhouse_gym.envs.observations import Observed, check_goals
from greenhouse_gym.envs.perception import Perception
from greenhouse_gym.envs.physics import AnyPhysics, Physics
from greenhouse_gym.envs.rewards import StepResult, Transition, total_reward, with_brush_cost, with_contact_cost
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.envs.setups import Setup, draw_setup
from greenhouse_gym.envs.state import HIDDEN, Ids, State, control_timing
from greenhouse_gym.envs.task import GoalTask, Outcome
from greenhouse_gym.envs.world import capacity_of
from greenhouse_gym.envs.worlds import shared_worlds
from greenhouse_gym.errors import InvalidValueError, NoEpisodeError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import CompiledScene, Scene
from greenhouse_gym.scene.mjcf import TIMESTEP
from greenhouse_gym.scene.plants.layout import Layout
from greenhouse_gym.scene.truth import without_plants

STEP_INFOS = ("previous_goal", "effort")
"""Keys of the info of a step that the info of a reset lacks, besides the reward terms."""

BRUSH_MEASURES = ("brushed_leaves", "brushed_time")
"""Keys of the info that describe how an episode treated leaves that give way."""


class Simulation:
    """Batch of n simulations of a task.

    Args:
        count: Number of simulations n.
        settings: The settings.
        threads: Number of simulation threads; 0 uses all cores.

    Attributes:
        settings: The settings.
        task: The task.
        step_limit: Steps after which an episode is truncated.
        robot: The arm.
        sampler: Draws the episodes.
        observe: The observation.
        action_space: Space of an action: entries that move the arm, then those of `Task.controls`.
        brush_cost: Reward per second in which a leaf is touched; None if leaves are rigid.
        measures: Keys of the numbers in the info that describe an episode in its record.
        state: State of the simulations; None before the first reset.
    """

    def __init__(self, count: int, settings: EnvSettings, threads: int = 0):
        self.settings = settings
        self.task = make_task(settings.task, settings.success_radius, settings.size)
        self.step_limit = settings.step_limit or self.task.step_limit
        compliant = settings.plants == "compliant"
        if self.task.layout is not None and not compliant:
            raise InvalidValueError(
                f'task {type(self.task).__name__} needs plants="compliant" and physics="truth", got plants='
                f"{settings.plants!r}"
            )
        self._checked = outcome_check(self.task)
        self.robot = robot = get_robot(settings.robot)
        self.sampler = EpisodeSampler(
            settings.bank, settings.split, robot, settings.difficulty, settings.start, settings.scene, settings.target,
            LARGEST_COMPLIANT if compliant else None,
        )  # fmt: skip
        self.observe = make_observation(settings.observation, robot, self.task)
        if compliant and self.task.camera:
            raise InvalidValueError("the camera of a task does not see plants that move: choose other plants")
        self._timing = control_timing(settings.rate)
        self.action_rule = make_action(settings.action, robot, self._timing.interval)
        self.action_space = with_controls(self.action_rule.space, self.task.controls)
        self._limit = CommandLimits(robot, self.action_rule, self._timing)
        self.reward_terms = make_reward(settings.reward, self.task)
        self.randomization = settings.randomization
        if self.randomization.plants is not None and settings.physics != "truth":
            raise InvalidValueError('randomization plants needs physics="truth", because the true plants move')
        reward_requires_roadmap = bool(getattr(self.reward_terms, "requires_roadmap", False))
        hidden = 'physics="truth"' if settings.physics == "truth" else ""
        hidden = hidden or ("target_position" if self.randomization.target_position else "")
        check_goals(self.observe, hidden, reward_requires_roadmap)
        self._hidden_goal = bool(hidden)
        capacity = settings.capacity or capacity_of(self.sampler.bank, settings.physics)
        layout = (self.task.layout or Layout()) if compliant else None
        leaves = "rigid" if settings.plants == "rigid" else "brush"
        self.worlds = shared_worlds(robot, settings.physics, capacity, self._timing.substeps, leaves, layout)
        self.brush_cost = self.task.brush_cost if settings.plants == "brush" else None
        memory = self.task.memory.items()
        self._numbers = tuple(name for name, v in memory if np.ndim(v) == 0 and not name.startswith(HIDDEN))
        self.measures = (*self._numbers, *(BRUSH_MEASURES if settings.plants == "brush" else ()))
        self.count = count
        self.state: State | None = None
        self._threads = threads
        self._physics: AnyPhysics | None = None
        self._reference: mujoco.MjModel | None = None
        self._setups: list[Setup | None] = [None] * count
        self._counts = EpisodeCounts(count)
        requires_roadmap = self.observe.requires_roadmap or reward_requires_roadmap
        self._perception = Perception(
            count, robot, self.observe, self.worlds, requires_roadmap, threads, self.task.camera
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> Simulation:
        """Return an independent copy in the same state; immutable parts are shared."""
        shared = [self.robot, self.settings, self.task, self.worlds, self.worlds.fields, self.sampler.bank]
        setups = [setup for setup in self._setups if setup is not None]
        shared += [part for setup in setups for part in (setup.episode, setup.world, setup.planted)]
        for part in shared:
            memo[id(part)] = part
        twin = memo[id(self)] = object.__new__(Simulation)
        twin.__dict__ = copy.deepcopy(self.__dict__, memo)
        return twin

    def reset(self, ids: Ids, rng: Sequence[np.random.Generator], options: Sequence[dict[str, Any] | None]) -> None:
        """Begin new episodes in some simulations. An error leaves everything unchanged.

        Args:
            ids: Indices of these simulations.
            rng: Generator of each of the n simulations.
            options: Reset options of each of the n simulations.
        """
        if self.state is None and len(ids) < self.count:
            self._current_state()
        required = self.observe.requires_occupancy
        first = self.state is None and self.count > 1
        setups = []
        with progress("scenes prepared", len(ids), shown=first) as on_progress:
            for i in ids:
                setups.append(
                    draw_setup(self.task, self.sampler, self.worlds, self.randomization, required, rng[i], options[i])
                )
                on_progress(len(setups))
        physics = self._physics
        if physics is None:
            world = setups[0].world
            self._reference = world.compiled.model
            ends_on = set(self.task.ends_on) - (set() if self.brush_cost is None else {"leaf"})
            physics = self._physics = (
                Physics(self.count, world, self._threads, self._timing, ends_on)
                if self.worlds.layout is None
                else CompliantPhysics(self.count, world, self._timing, ends_on, self.worlds.layout)
            )
        for setup in setups:
            assert self._reference is not None
            setup.world.check_fits(self._reference)
        with progress("simulations begun", len(ids), shown=first) as on_progress:
            for done, (i, setup) in enumerate(zip(ids.tolist(), setups, strict=True), start=1):
                physics.load(i, setup.world, self._touchable(setup.episode), setup.disturbance, setup.planted)
                self._setups[i] = setup
                self._counts.begin(i, setup.episode)
                self._perception.begin(i, setup)
                on_progress(done)
        contacts = physics.place(ids, np.array([setup.episode.start for setup in setups]))
        self._counts.record(contacts)
        begun = [remembered(self.task, {**self.task.memory, **self.task.begin(setup.world)}) for setup in setups]
        memory = {name: np.stack([values[name] for values in begun]) for name in self.task.memory}
        fresh, _ = self._look(ids, contacts, self._counts.steps, memory)
        self.state = fresh if len(ids) == self.count else self._current_state().replaced(ids, fresh)

    def set_images_due(self, i: int, due: bool) -> None:
        """Set whether the next observations of a simulation have images; if not, these are zero, which saves time."""
        self._perception.images_due[i] = due

    def close(self) -> None:
        """Free the simulations; the next reset creates new ones."""
        self._perception.close()
        self._physics = self.state = None

    def step(self, actions: Any) -> StepResult:
        """Advance all simulations by one action each, (n, size).

        Raises:
            InvalidValueError: The actions have the wrong shape or are not finite.
        """
        before, physics, counts = self._current_state(), self._physics, self._counts
        action = check_actions(actions, self.count, self.action_space)
        arm, controls = np.split(action, self.action_rule.space.shape, axis=1)
        assert physics is not None
        shown = self._shown_to(self.action_rule, before)
        change = self.action_rule(arm, shown, physics.motion(self._perception.heading))
        command = self._limit(physics.command, change, physics.qpos)
        contacts = physics.advance(command.position, self.task.holds(controls))
        counts.add_step(command, contacts)
        memory = self._with_views(before.memory, np.flatnonzero(self.task.looks(controls)))
        after, outcome = self._look(slice(None), contacts, counts.steps, memory)
        self.state = after
        transition = Transition(
            before.distance, after.distance, after.collided, after.success, squared_norm(action), counts.steps,
            (before, after),
        )  # fmt: skip
        terms = self.reward_terms(transition)
        if self.task.costs:
            terms = with_contact_cost(terms, self.task.costs, contacts.counts)
        if self.brush_cost is not None:
            terms = with_brush_cost(
                terms, self.brush_cost, np.multiply(TIMESTEP, contacts.leaf_steps, dtype=np.float64)
            )
        terminated = after.success | after.failure
        if outcome.next_target is not None:
            self._advance_targets(np.flatnonzero(outcome.next_target & ~terminated & (after.remaining > 1)))
        truncated = (counts.steps >= self.step_limit) & ~terminated
        return StepResult(total_reward(terms), terms, terminated, truncated, transition)

    def _look(
        self, ids: Ids | slice, contacts: Contacts, steps: npt.NDArray[np.int64], memory: Mapping[str, Array]
    ) -> tuple[State, Outcome]:
        """Return the state of some simulations and the outcome of their task."""
        assert self._physics is not None
        state = self._perception.look(ids, self._physics, contacts, steps, memory)
        outcome = self._checked(self.task.evaluate(state), len(state.joints))
        return state.with_outcome(*outcome[:3], {**memory, **outcome.memory} if memory else memory), outcome

    def _with_views(self, memory: Mapping[str, Array], ids: Ids) -> Mapping[str, Array]:
        """Return the task's memory after some simulations have taken a view."""
        if not len(ids):
            return memory
        assert self._physics is not None
        memory = {name: values.copy() for name, values in memory.items()}
        for i, view in zip(ids, self._perception.take_views(ids, self._physics), strict=True):
            seen = self.task.see(view, {name: values[i] for name, values in memory.items()})
            for name, value in remembered(self.task, seen).items():
                memory[name][i] = value
        return memory

    def _touchable(self, episode: Episode) -> tuple[int, ...]:
        """Return the tomatoes that the cup may touch."""
        return episode.targets if self.task.allows_cup_contact else ()

    def _advance_targets(self, ids: Ids) -> None:
        """Make the next target of some simulations the current one, which affects the next observation."""
        if not len(ids):
            return
        state, counts = self._current_state(), self._counts
        counts.index[ids] += 1
        for i in ids.tolist():
            counts.target[i] = self.episode(i).targets[counts.index[i]]
            self._perception.set_target(i, counts.index[i], self.command[i].copy())
        contacts = Contacts(state.contacts[ids], np.zeros_like(ids), state.collided[ids], {})
        memory = {name: values[ids] for name, values in state.memory.items()}
        fresh, _ = self._look(ids, contacts, np.zeros_like(counts.steps), memory)
        done = np.zeros(len(ids), dtype=np.bool_)
        self.state = state.replaced(ids, fresh._replace(success=done, failure=done, memory=memory))

    def observation(self, ids: Ids | None = None) -> Observed:
        """Return observations of all or some simulations."""
        state = self._current_state()
        return self.observe(self._shown_to(self.observe, state if ids is None else state.select(ids)))

    def info(self, step: StepResult | None = None) -> dict[str, npt.NDArray[Any]]:
        """Return the info that `GreenhouseEnv` documents, without reward terms, as live arrays of length n.

        Contacts are an array (n, groups).
        """
        state = self._current_state()
        result = {**self._counts.info(state), **{name: state.memory[name] for name in self._numbers}}
        if self.brush_cost is not None:
            assert isinstance(self._physics, Physics)
            result |= self._counts.brush_info()
            result["brushed_leaves"] = np.array([len(leaves) for leaves in self._physics.brushed])
        if step is not None and self.observe.has_goals:
            assert isinstance(self.task, GoalTask)
            result["previous_goal"], _ = self.task.goals(step.transition.start)
            result["effort"] = step.transition.effort
        return result

    def episode(self, i: int) -> Episode:
        """Return the current episode of a simulation."""
        return self._setup(i).episode

    def known_scene(self, i: int) -> Scene:
        """Return the current scene of a simulation as agents know it, see `known_scene` and `Task.knows_scan`."""
        known = self._setup(i).world.known
        return known if self.task.knows_scan else without_plants(known)

    def target(self, i: int) -> int:
        """Return the current target of a simulation, an index into the tomatoes of its scene."""
        self._current_state()
        return int(self._counts.target[i])

    @property
    def command(self) -> Array:
        """(n, j) commanded joint positions, radians, live."""
        assert self._physics is not None
        return self._physics.command

    @property
    def interval(self) -> float:
        """Time between two actions, seconds."""
        return self._timing.interval

    @property
    def joints(self) -> Array:
        """(n, j) true joint positions, radians, live; observed ones may have errors."""
        assert self._physics is not None
        return self._physics.qpos

    def physical(self, i: int) -> tuple[CompiledScene, int]:
        """Return the simulated scene, the true row or the scene itself, and the index of the current target in it."""
        world = self._setup(i).world
        return world.rigid, int(world.bodies[self.target(i)])

    def tip(self, i: int) -> Array:
        """Return the position (3,) of the tip in the scene, metres."""
        assert self._physics is not None
        return np.array(self._physics.sites(np.array([i]))[0][0, 0])

    def goal(self, i: int) -> Array:
        """Return the center (3,) of the simulated current target in the scene, metres."""
        return self._setup(i).world.goal_in_scene(self.target(i))

    def model_and_data(self, i: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return a copy of a simulation's model, in which the cup may touch the targets, and its state."""
        setup = self._setup(i)
        assert self._physics is not None
        return self._physics.model_and_data(i, self._touchable(setup.episode), setup.disturbance)

    def live(self, i: int) -> CompliantSimulation:
        """Return the compliant plants of a simulation as they are.

        Raises:
            InvalidValueError: The plants are rigid.
        """
        return self._compliant.simulation(i)

    def rehearsal(self, i: int) -> CompliantPhysics:
        """Return a copy of a simulation with compliant plants to try actions in, for agents that may know everything.

        Raises:
            InvalidValueError: The plants are rigid.
        """
        return self._compliant.twin(i)

    @property
    def _compliant(self) -> CompliantPhysics:
        if not isinstance(self._physics, CompliantPhysics):
            raise InvalidValueError('plants hang live with plants="compliant" alone; use task="harvest"')
        return self._physics

    def _shown_to(self, part: object, state: State) -> State:
        """Return the state as an observation or action gets it; those of a user may not know all of it."""
        return state.known(self._hidden_goal) if isinstance(part, OwnPart) else state

    def _current_state(self) -> State:
        if self.state is None:
            raise NoEpisodeError("there is no episode yet: reset the whole environment first")
        return self.state

    def _setup(self, i: int) -> Setup:
        self._current_state()
        setup = self._setups[i]
        assert setup is not None
        return setup
