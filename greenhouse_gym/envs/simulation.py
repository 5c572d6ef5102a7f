"""n simulations of the reaching task: what both environments are made of."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.actions import CommandLimits, check_actions, squared_norm
from greenhouse_gym.envs.choices import make_action, make_observation, make_reward
from greenhouse_gym.envs.episodes import Episode, EpisodeSampler
from greenhouse_gym.envs.observations import Observed, check_goals_are_known, check_goals_stay
from greenhouse_gym.envs.perception import Perception
from greenhouse_gym.envs.physics import NOTHING, Contacts, Physics, prepare
from greenhouse_gym.envs.randomization import Disturbance, draw_disturbance
from greenhouse_gym.envs.reach_task import RATE, Bools, State, control_timing
from greenhouse_gym.envs.rewards import Terms, Transition, total_reward
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.envs.stepping import Ids
from greenhouse_gym.envs.worlds import World, room_for, worlds_of
from greenhouse_gym.errors import InvalidValueError, NoEpisodeError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import ROBOTS, get_robot
from greenhouse_gym.scene import CompiledScene, Scene
from greenhouse_gym.scene.occupancy import require_occupancy

STEP_INFOS = ("previous_goal", "effort")
"""Keys of the info that a step has and a reset has not, beside the reward's terms."""


class StepResult(NamedTuple):
    """What one step of n simulations gave.

    Attributes:
        reward: (n,).
        terms: The reward's terms by name, each (n,).
        terminated: (n,) success or collision.
        truncated: (n,) the step limit was reached without either.
        transition: What the reward was computed from.
        previous: (n, 3) grasp point before the step, metres.
    """

    reward: Array
    terms: Terms
    terminated: Bools
    truncated: Bools
    transition: Transition
    previous: Array


class ReachSimulation:
    """n simulations of the reaching task.

    Args:
        count: Number of simulations n.
        settings: What they are made of.
        threads: Threads of the batch; 0 uses all cores.

    Attributes:
        settings: What they are made of.
        robot: The arm.
        sampler: Draws the episodes.
        observe: Makes the observations.
        state: What the simulations look like now; None before the first reset.
    """

    def __init__(self, count: int, settings: EnvSettings, threads: int = 0):
        self.settings = settings
        self.robot = robot = get_robot(settings.robot)
        self.sampler = EpisodeSampler(settings.bank, settings.split, robot, settings.difficulty, settings.start)
        self.observe = make_observation(settings.observation, robot)
        self._timing = control_timing(settings.rate)
        self.action_rule = make_action(settings.action, robot, self._timing.interval)
        self._limit = CommandLimits(robot, self.action_rule, self._timing)
        self.reward_terms = make_reward(settings.reward)
        self.randomization = settings.randomization
        if self.randomization.plants is not None and settings.physics != "truth":
            raise InvalidValueError('randomization plants needs physics="truth": it is the true plants that move')
        hidden = 'physics="truth"' if settings.physics == "truth" else ""
        check_goals_are_known(self.observe, hidden or ("target_position" if self.randomization.target_position else ""))
        name = robot.name if robot.name in ROBOTS else str(robot.path)
        self.env_options: dict[str, Any] = {
            "robot": name,
            "observation": settings.observation,
            "action": settings.action,
        }
        if settings.rate != RATE:
            self.env_options["rate"] = settings.rate
        capacity = settings.capacity or room_for(self.sampler.bank, settings.physics)
        self.worlds = worlds_of(robot, settings.physics, capacity, self._timing.substeps)
        self.count = count
        self.state: State | None = None
        self._threads = threads
        self._physics: Physics | None = None
        self._episodes: list[Episode | None] = [None] * count
        self._worlds: list[World | None] = [None] * count
        self._disturbances: list[Disturbance | None] = [None] * count
        self._names = {key: np.full(count, "", dtype=object) for key in ("scene", "difficulty")}
        self._contact, self._self_collision = np.full(count, None, dtype=object), np.zeros(count, dtype=np.bool_)
        # Counts of the episode so far; the target's index is kept with them.
        self._counts = {
            key: np.zeros(count, dtype=np.int64) for key in ("steps", "speed_limited", "position_limited", "target")
        }
        reward_requires_roadmap = bool(getattr(self.reward_terms, "requires_roadmap", False))
        check_goals_stay(self.observe, reward_requires_roadmap)
        self._perception = Perception(
            count,
            robot,
            self.observe,
            self.worlds,
            settings.success_radius,
            self.observe.requires_roadmap or reward_requires_roadmap,
            threads,
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> ReachSimulation:
        """The same state, to go on from independently; what is never changed is shared."""
        shares = self.robot, self.settings, self.worlds, self.sampler.bank
        for shared in (*shares, *self._worlds, *self._episodes):
            memo[id(shared)] = shared
        twin = memo[id(self)] = object.__new__(ReachSimulation)
        twin.__dict__ = copy.deepcopy(self.__dict__, memo)
        return twin

    # -- reset --------------------------------------------------------------------------------------------------------

    def reset(
        self,
        ids: Ids,
        rng: Sequence[np.random.Generator],
        options: Sequence[dict[str, Any] | None],
    ) -> None:
        """Begin new episodes in some simulations, each drawn with its own generator ``rng[i]``.

        An error leaves all as it was.

        Args:
            ids: Indices of these simulations.
            rng: A generator for each of the n simulations.
            options: Options of the reset for each of the n simulations.
        """
        episodes = [self.sampler.draw(rng[i], options[i]) for i in ids]
        if self.observe.requires_occupancy:
            for episode in episodes:
                require_occupancy(
                    episode.scene.occupancy, episode.scene.name, "the observation", 'observe the "state" alone'
                )
        disturbances = [draw_disturbance(self.randomization, len(self.robot.joints), rng[i]) for i in ids]
        worlds = [
            self._world(episode.scene, disturbance.plants)
            for episode, disturbance in zip(episodes, disturbances, strict=True)
        ]
        physics = self._physics
        if physics is None:
            physics = self._physics = Physics(self.count, worlds[0], self._threads, self._timing)
        for world in worlds:
            world.check_fits(physics.models[0])
        for i, episode, world, disturbance in zip(ids, episodes, worlds, disturbances, strict=True):
            physics.load(int(i), world, episode.target, disturbance)
            self._begin(int(i), episode, world, disturbance)
        touches = physics.place(ids, np.array([episode.start for episode in episodes]))
        self._contact[ids], self._self_collision[ids] = None, False
        for i in ids:
            self._contact[i] = NOTHING.names
        self._note(touches)
        fresh = self._perception.look(ids, physics, touches.any, self._counts["steps"])
        self.state = fresh if len(ids) == self.count else self._seen().replaced(ids, fresh)

    def _world(self, scene: Scene, moved: int | None) -> World:
        """The world of an episode; ``moved`` is the seed of how the plants moved, or None."""
        world, motion = self.worlds.world(scene, self.sampler.at_a_time), self.randomization.plants
        return world if motion is None or moved is None else self.worlds.moved(world, motion, moved)

    def _begin(self, i: int, episode: Episode, world: World, disturbance: Disturbance) -> None:
        self._episodes[i], self._worlds[i], self._disturbances[i] = episode, world, disturbance
        self._names["scene"][i], self._names["difficulty"][i] = episode.scene.name, episode.difficulty
        for counts in self._counts.values():
            counts[i] = 0
        self._counts["target"][i] = episode.target
        self._perception.begin(i, episode, world, disturbance)

    def close(self) -> None:
        """Free the simulations; the next reset makes new ones."""
        self._perception.close()
        self._physics = self.state = None

    # -- step ---------------------------------------------------------------------------------------------------------

    def step(self, actions: Any) -> StepResult:
        """Advance all simulations by one action each, (n, size) in [-1, 1].

        Raises:
            InvalidValueError: The actions have the wrong shape or are not finite.
        """
        before, physics = self._seen(), self._physics
        action = check_actions(actions, self.count, self.action_rule.space)
        assert physics is not None
        change = self.action_rule(action, before, physics.motion(self._perception.heading))
        command = self._limit(physics.command, change, physics.qpos)
        touches = physics.advance(command.position)
        self._note(touches)
        counts = self._counts
        counts["steps"] += 1
        counts["speed_limited"] += command.speed_limited
        counts["position_limited"] += command.position_limited
        after = self.state = self._perception.look(slice(None), physics, touches.any, counts["steps"])
        transition = Transition(
            before.distance, after.distance, after.collided, after.success, squared_norm(action), counts["steps"],
            (before, after),
        )  # fmt: skip
        terms = self.reward_terms(transition)
        terminated = after.success | after.collided
        truncated = (counts["steps"] >= self.settings.step_limit) & ~terminated
        return StepResult(total_reward(terms), terms, terminated, truncated, transition, before.grasp)

    def _note(self, touches: Contacts) -> None:
        for i, contact in touches.contacts.items():
            self._contact[i], self._self_collision[i] = contact.names, contact.self_collision

    # -- what the environments tell -----------------------------------------------------------------------------------

    def observation(self, ids: Ids | None = None) -> Observed:
        """Observations of all simulations, or of some."""
        return self.observe(self._seen() if ids is None else self._seen().select(ids))

    def info(self, step: StepResult | None = None) -> dict[str, npt.NDArray[Any]]:
        """What the environments' docstring promises, but for the reward's terms, as live arrays of length n."""
        seen, counts = self._seen(), self._counts
        result: dict[str, npt.NDArray[Any]] = {
            "is_success": seen.success,
            "collision": seen.collided,
            "contact": self._contact,
            "self_collision": self._self_collision,
            "distance": seen.distance,
            "clearance": seen.clearance.min(axis=1).astype(np.float64),
            "scene": self._names["scene"],
            "target": counts["target"],
            "difficulty": self._names["difficulty"],
            "steps": counts["steps"],
            "speed_limited": counts["speed_limited"],
            "position_limited": counts["position_limited"],
        }
        if step is not None and self.observe.has_goals:
            result["previous_goal"], result["effort"] = step.previous, step.transition.effort
        return result

    def episode(self, i: int) -> Episode:
        """The current episode of a simulation."""
        self._seen()
        episode = self._episodes[i]
        assert episode is not None
        return episode

    @property
    def command(self) -> Array:
        """(n, j) commanded joint positions, radians, live."""
        assert self._physics is not None
        return self._physics.command

    @property
    def interval(self) -> float:
        """Seconds from one action to the next."""
        return self._timing.interval

    @property
    def joints(self) -> Array:
        """(n, j) true joint positions, radians, live; observations may tell wrong ones."""
        assert self._physics is not None
        return self._physics.qpos

    def physical(self, i: int) -> tuple[CompiledScene, int]:
        """What a simulation's physics run on, and the index of the target there: the scene's, or the truth's."""
        world = self._worlds[i]
        assert world is not None
        return world.compiled, int(world.bodies[self.episode(i).target])

    def tip(self, i: int) -> Array:
        """(3,) the tip in the scene, metres."""
        assert self._physics is not None
        return np.array(self._physics.sites(np.array([i]))[0][0, 0])

    def goal(self, i: int) -> Array:
        """(3,) center in the scene of what has to be reached, metres."""
        world = self._worlds[i]
        assert world is not None
        return world.goal_in_scene(self.episode(i).target)

    def model_and_data(self, i: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """A simulation's model (a copy of the episode's, the cup allowed on the target) and its state."""
        self._seen()
        world, disturbance, physics = self._worlds[i], self._disturbances[i], self._physics
        assert world is not None
        assert disturbance is not None
        assert physics is not None
        model = copy.copy(world.compiled.model)
        prepare(model, world, self.episode(i).target, disturbance)
        data = mujoco.MjData(model)
        physics.copy_state(i, model, data)
        return model, data

    def _seen(self) -> State:
        if self.state is None:
            raise NoEpisodeError("there is no episode yet: reset the whole environment first")
        return self.state
