"""n simulations of the reaching task on one `mujoco.batch.Batch`: what both environments are made of."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from greenhouse_gym.envs.clearance import FAR_AWAY, nearest_obstacle, to_base
from greenhouse_gym.envs.episodes import Episode, EpisodeSampler
from greenhouse_gym.envs.observations import OBSERVATIONS
from greenhouse_gym.envs.reach_task import (
    ACTIONS,
    REWARDS,
    STEP_LIMIT,
    SUBSTEPS,
    Bools,
    Float32,
    Situation,
    check_actions,
    total_reward,
)
from greenhouse_gym.envs.worlds import World, worlds_of
from greenhouse_gym.errors import UnknownNameError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.robots.robot import ROBOTS
from greenhouse_gym.scene import SceneBank

Ids = npt.NDArray[np.int64]
Contact = tuple[str, ...]
"""Names of two geoms that touch, the arm's part first; empty when nothing is touched."""

_POSITIONS = mujoco.mjtStage.mjSTAGE_POS


@dataclass(frozen=True, eq=False)
class StepResult:
    """What one step of n simulations gave.

    Attributes:
        situation: The situation after the step.
        reward: (n,).
        terms: The reward's terms by name, each (n,).
        terminated: (n,) success or collision.
        truncated: (n,) the step limit was reached without either.
    """

    situation: Situation
    reward: Array
    terms: dict[str, Array]
    terminated: Bools
    truncated: Bools


class ReachSimulation:
    """n simulations, each on a private padded model into which a reset copies the episode's scene.

    Args:
        count: Number of simulations n.
        bank: Name or folder of the scene bank, or a `SceneBank`.
        split: Split the episodes are drawn from.
        robot: Name or MJCF file of the arm.
        observation: One of `OBSERVATIONS`.
        action: One of `ACTIONS`.
        reward: One of `REWARDS`.
        difficulty: Difficulties that are drawn.
        physics: "reconstruction", or "truth" to simulate the true row behind the scene.
        threads: Threads of the batch; 0 uses all cores.
    """

    def __init__(
        self,
        count: int,
        *,
        bank: str | Path | SceneBank,
        split: str,
        robot: str | Path | Robot,
        observation: str,
        action: str,
        reward: str,
        difficulty: str | Iterable[str],
        physics: str,
        threads: int = 0,
    ):
        self.robot = get_robot(robot)
        self.sampler = EpisodeSampler(bank, split, self.robot, difficulty)
        self.observe = _choose("observation", observation, OBSERVATIONS)(self.robot)
        self.command_rule = _choose("action", action, ACTIONS)
        self.reward_terms = _choose("reward", reward, REWARDS)
        name = self.robot.name if self.robot.name in ROBOTS else str(self.robot.path)
        self.env_options = {"robot": name, "observation": observation, "action": action}
        self.worlds = worlds_of(self.robot, physics)
        self.count = count
        self.steps = np.zeros(count, dtype=np.int64)
        self.situation: Situation | None = None
        self.contact = np.full(count, None, dtype=object)
        self._scene_name, self._difficulty = np.full(count, "", dtype=object), np.full(count, "", dtype=object)
        self._tomato = np.zeros(count, dtype=np.int64)
        self._episodes: dict[int, Episode] = {}
        self._worlds: dict[int, World] = {}
        self._batch: Batch | None = None
        self._threads = threads
        self._command = np.zeros((count, len(self.robot.joints)))
        self._field = np.zeros(count, dtype=np.int64)
        self._frame = np.zeros((count, 5))  # base position and cosine, sine of its heading
        self._target = np.zeros((count, 3))  # in the base frame
        self._goal = np.zeros((count, 4))  # in the scene, and radius
        self._tomatoes = np.zeros((4, count, 1), dtype=np.float32)
        self._probe_radii = self.robot.probe_radii.astype(np.float32)

    # -- reset --------------------------------------------------------------------------------------------------------

    def reset(self, ids: Ids, random: Sequence[np.random.Generator], options: dict[str, Any] | None = None) -> None:
        """Begin new episodes in some simulations, each drawn with its own generator ``random[i]``."""
        episodes = [self.sampler.draw(random[i], options) for i in ids]
        worlds = [self.worlds.world(episode.scene) for episode in episodes]
        batch = self._batch or self._make_batch(worlds[0])
        for i, episode, world in zip(ids, episodes, worlds, strict=True):
            self._begin(int(i), episode, world)
        batch.set_models(self._models)
        batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._qpos[ids] = self._command[ids]
        self._ctrl[ids] = self._command[ids]
        batch.forward(ids, stage=_POSITIONS)
        touched = self._ncon[ids] > 0
        for i, touches in zip(ids, touched, strict=True):
            self.contact[i] = self._contact_names(int(i), self._qpos[i]) if touches else _NOTHING
        fresh = self._look(ids, touched)
        self.situation = fresh if len(ids) == self.count else self._seen().replaced(ids, fresh)

    def _make_batch(self, world: World) -> Batch:
        compiled = world.compiled
        self._models = [copy.copy(compiled.model) for _ in range(self.count)]
        self._data = mujoco.MjData(compiled.model)
        self._tip, self._probes = compiled.tip_site, compiled.probe_sites
        batch = self._batch = Batch(compiled.model, self.count, self._threads)
        self._qpos, self._qvel, self._ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        self._site_xpos, self._site_xmat = batch.bind("site_xpos"), batch.bind("site_xmat")
        self._ncon = batch.bind("ncon")
        return batch

    def _begin(self, i: int, episode: Episode, world: World) -> None:
        world.load(self._models[i], episode.target)
        self._episodes[i], self._worlds[i] = episode, world
        self._scene_name[i], self._tomato[i] = episode.scene.name, episode.target
        self._difficulty[i] = episode.difficulty
        self.steps[i] = 0
        self._command[i] = episode.start
        self._field[i] = world.field
        self._frame[i] = world.frame
        self._target[i] = world.tomatoes[episode.target, :3]
        center, radius = world.goal(episode.target)
        self._goal[i] = [*center, radius]
        count, room = len(world.tomatoes), self._tomatoes.shape[2]
        if count > room:
            padding = np.broadcast_to(FAR_AWAY[:, None], (4, self.count, count - room))
            self._tomatoes = np.concatenate([self._tomatoes, padding], axis=2)
        self._tomatoes[:, i] = FAR_AWAY
        self._tomatoes[:, i, :count] = world.tomatoes.T
        self._tomatoes[:, i, episode.target] = FAR_AWAY[:, 0]

    # -- step ---------------------------------------------------------------------------------------------------------

    def step(self, actions: Any) -> StepResult:
        """Advance all simulations by one action each, (n, joints) in [-1, 1].

        Raises:
            InvalidValueError: The actions have the wrong shape or are not finite.
        """
        action = check_actions(actions, self._command.shape)
        before, batch = self._seen(), self._batch
        assert batch is not None
        command = self.command_rule(self._command, action, before.joints, self.robot.lower, self.robot.upper)
        ramp = self._command[:, None] + (command - self._command)[:, None] * _RAMP
        # A step's derived values are one substep old: the record tells what was touched at the starts of the
        # substeps, the last forward what is touched at the end.
        record = batch.rollout(SUBSTEPS, ramp, int(mujoco.mjtState.mjSTATE_CTRL), record=("ncon", "qpos"))
        batch.forward(stage=_POSITIONS)
        self._command = command
        touching = np.concatenate([record["ncon"].reshape(self.count, SUBSTEPS), self._ncon[:, None]], axis=1) > 0
        touched = touching.any(axis=1)
        self.contact.fill(_NOTHING)
        for i in np.flatnonzero(touched):
            first = int(touching[i].argmax())
            configuration = record["qpos"][i, first - 1] if first else before.joints[i]
            self.contact[i] = self._contact_names(int(i), configuration)
        self.steps += 1
        after = self.situation = self._look(slice(None), touched)
        terms = self.reward_terms(before, after, action)
        terminated = after.success | touched
        truncated = (self.steps >= STEP_LIMIT) & ~terminated
        return StepResult(after, total_reward(terms), terms, terminated, truncated)

    # -- what the environments tell -----------------------------------------------------------------------------------

    def observation(self, ids: Ids | None = None) -> Float32:
        """Observations of all simulations, or of some."""
        return self.observe(self._seen() if ids is None else self._seen().select(ids))

    def info(self) -> dict[str, npt.NDArray[Any]]:
        """What the environments' docstring promises, as new arrays of length n."""
        seen = self._seen()
        return {
            "is_success": seen.success,
            "collision": seen.touched.copy(),
            "contact": self.contact.copy(),
            "distance": seen.distance.copy(),
            "clearance": seen.clearance.min(axis=1).astype(np.float64),
            "scene": self._scene_name.copy(),
            "target": self._tomato.copy(),
            "difficulty": self._difficulty.copy(),
        }

    def episode(self, i: int) -> Episode:
        """The current episode of a simulation."""
        self._seen()
        return self._episodes[i]

    def tip(self, i: int) -> Array:
        """(3,) the tip in the scene, metres."""
        return np.array(self._site_xpos[i, self._tip])

    def goal(self, i: int) -> Array:
        """(3,) center in the scene of what has to be reached, metres."""
        return self._goal[i, :3].copy()

    def model_and_data(self, i: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """A simulation's model (a copy of the episode's, the cup allowed on the target) and its state."""
        self._seen()
        model = copy.copy(self._worlds[i].compiled.model)
        self._worlds[i].load(model, self.episode(i).target)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = self._qpos[i], self._qvel[i], self._ctrl[i]
        mujoco.mj_forward(model, data)
        return model, data

    def _seen(self) -> Situation:
        if self.situation is None:
            raise RuntimeError("reset the whole environment first")
        return self.situation

    # -- looking ------------------------------------------------------------------------------------------------------

    def _look(self, ids: Ids | slice, touched: npt.ArrayLike) -> Situation:
        """The situation of some simulations from their current kinematics."""
        frame = self._frame[ids]
        positions, tip_frame = self._site_xpos[ids], self._site_xmat[ids][:, self._tip].reshape(-1, 9)
        goal = self._goal[ids]
        grasp = positions[:, self._tip] + goal[:, 3:] * tip_frame[:, 2::3]
        gap = grasp - goal[:, :3]
        joints = self._qpos[ids].copy()
        probes = to_base(positions[:, self._probes], frame)
        distance, direction = nearest_obstacle(self.worlds.fields, self._field[ids], self._tomatoes[:, ids], probes)
        return Situation(
            joints=joints,
            velocities=self._qvel[ids].copy(),
            command=self._command[ids].copy(),
            grasp=to_base(grasp[:, None], frame)[:, 0],
            target=self._target[ids].copy(),
            distance=np.sqrt(gap[:, 0] ** 2 + gap[:, 1] ** 2 + gap[:, 2] ** 2),
            clearance=distance - self._probe_radii,
            obstacle=direction,
            touched=np.asarray(touched, dtype=np.bool_),
        )

    def _contact_names(self, i: int, configuration: Array) -> Contact:
        """The deepest contact of a simulation at a configuration."""
        model, data = self._models[i], self._data
        data.qpos[:] = configuration
        mujoco.mj_fwdPosition(model, data)
        if data.ncon == 0:
            return _NOTHING
        contact = data.contact[int(np.argmin(data.contact.dist))]
        geoms = sorted((int(contact.geom1), int(contact.geom2)), key=lambda g: model.geom_bodyid[g], reverse=True)
        return tuple(str(self._worlds[i].compiled.model.geom(g).name) for g in geoms)


_NOTHING: Contact = ()
_RAMP = (np.arange(1, SUBSTEPS + 1) / SUBSTEPS)[:, None]


def _choose(kind: str, name: str, choices: dict[str, Any]) -> Callable[..., Any]:
    if name not in choices:
        raise UnknownNameError(kind, name, choices)
    return choices[name]  # type: ignore[no-any-return]
