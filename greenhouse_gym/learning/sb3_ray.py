"""Stable-Baselines3 over a Ray cluster: actors step parts of the simulations, and one learner reads them all."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.executors import RayActor, RayExecutor, workers_of
from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs import EnvSettings, make_vec_env
from greenhouse_gym.envs.observations import Observed
from greenhouse_gym.envs.settings import check_whole, settings_with
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.learning.sb3_steps import Stepped, steps_of

with needs("train"):
    from stable_baselines3.common.vec_env import VecEnv, VecMonitor


class RayVecEnv(VecEnv):  # type: ignore[misc]
    """Simulations that Ray actors step, behind the interface of `greenhouse_gym.learning.sb3.Sb3VecEnv`.

    Simulation i has the seed s + i whichever actor steps it, so observations, rewards and infos are those of the local
    environment bit for bit, where episodes are drawn from the whole split (of up to 300 scenes). Attributes are those
    of one more simulation, which stays here and is not stepped.

    Args:
        num_envs: Number of simulations, of all actors together.
        settings: What they are made of.
        actors: Number of actors.
        threads: Threads of each actor, which takes as many cores.
        address: Address of the cluster, as `RayExecutor` takes it.

    Raises:
        InvalidValueError: There are more actors than simulations or cores, or no cluster at the address.
        MissingDependencyError: Ray is not installed.
    """

    def __init__(self, num_envs: int, settings: EnvSettings, actors: int = 2, threads: int = 1, address: str = "local"):
        check_whole("actors", actors, 1)
        check_whole("threads", threads, 1)
        check_whole("num_envs", num_envs, actors)
        self._actors: list[RayActor] = []
        self._here = make_vec_env(1, settings, autoreset_mode="SameStep", threads=1)
        super().__init__(num_envs, self._here.single_observation_space, self._here.single_action_space)
        self._cluster = RayExecutor(address, cpus=threads, workers=actors * threads)
        if actors > (most := workers_of(self._cluster)):
            self.close()
            raise InvalidValueError(f"the cluster has cores for {most} actors, got {actors}")
        bounds = [num_envs * k // actors for k in range(actors + 1)]
        self._parts = [slice(*ends) for ends in pairwise(bounds)]
        for piece in self._parts:
            self._actors.append(
                RayActor(self._cluster, steps_of, piece.stop - piece.start, settings, threads, cpus=threads)
            )
        self._steps: list[Any] = []

    def reset(self) -> Observed:
        """Begin new episodes everywhere and return the observations (n, size)."""
        answers = [
            actor.ask("begin", self._seeds[part], self._options[part])
            for actor, part in zip(self._actors, self._parts, strict=True)
        ]
        observations, infos = zip(*(answer() for answer in answers), strict=True)
        self.reset_infos = [info for part in infos for info in part]
        self._reset_seeds()
        self._reset_options()
        return _together(observations)

    def step_async(self, actions: npt.NDArray[np.float32]) -> None:
        """Have every actor begin its step."""
        self._steps = [
            actor.ask("act", np.ascontiguousarray(actions[part]))
            for actor, part in zip(self._actors, self._parts, strict=True)
        ]

    def step_wait(self) -> Stepped:
        """What came of the step; episodes that ended have begun anew."""
        observations, rewards, dones, infos = zip(*(answer() for answer in self._steps), strict=True)
        every = [info for part in infos for info in part]
        return _together(observations), np.concatenate(rewards), np.concatenate(dones), every

    def close(self) -> None:
        """End the actors, and leave the cluster if it was joined for them."""
        for actor in self._actors:
            actor.end()
        self._cluster.shutdown()
        self._here.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The attribute of the simulation that stays here, once per index."""
        return [getattr(self._here, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused: there is nothing that all actors would share.

        Raises:
            InvalidValueError: Always.
        """
        raise InvalidValueError(f"attribute {attr_name!r} cannot be set in the actors: give it when they are made")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method in all actors, and here for the result; one that only computes, here alone.

        Raises:
            InvalidValueError: Only some of the simulations are meant, and the method does more than compute.
        """
        chosen = set(self._get_indices(indices))
        if not method_name.startswith("compute_"):
            if chosen != set(range(self.num_envs)):
                raise InvalidValueError(f"method {method_name!r} belongs to all {self.num_envs} simulations together")
            for answer in [a.ask("call", method_name, method_args, method_kwargs) for a in self._actors]:
                answer()
        result = getattr(self._here, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """No simulation is wrapped."""
        return [False for _ in self._get_indices(indices)]


def make_sb3_ray_vec_env(
    num_envs: int = 128,
    settings: EnvSettings | None = None,
    *,
    actors: int = 2,
    threads: int = 1,
    address: str = "local",
    seed: int | None = None,
    **fields: Any,
) -> VecMonitor:
    """`greenhouse_gym.learning.sb3.make_sb3_vec_env` with the simulations in the actors of a Ray cluster.

    Args:
        num_envs: Number of simulations.
        settings: What they are made of; the usual `EnvSettings` when left out.
        actors: Number of actors.
        threads: Threads of each actor, which takes as many cores; 0, which means all cores elsewhere, is one here.
        address: "local", "auto" or HOST:PORT of the cluster's head.
        seed: Seeds the simulations' generators with seed + i at the first reset.
        **fields: Fields of `EnvSettings`.

    Raises:
        InvalidValueError: There are more actors than simulations or cores, or no cluster at the address.
        MissingDependencyError: Ray is not installed.
    """
    chosen = settings_with("make_sb3_ray_vec_env", settings, fields)
    env = RayVecEnv(num_envs, chosen, actors, threads or 1, address)
    if seed is not None:
        env.seed(seed)
    return VecMonitor(env)


def _together(parts: Sequence[Observed]) -> Observed:
    """The observations of all simulations."""
    first = parts[0]
    if isinstance(first, dict):
        return {key: np.concatenate([part[key] for part in parts]) for key in first}  # type: ignore[index]
    return np.concatenate(parts)  # type: ignore[arg-type]
