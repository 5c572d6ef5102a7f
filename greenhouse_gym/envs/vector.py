"""The vector environment: many simulations in one `mujoco.batch.Batch`, not many environments."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from greenhouse_gym.envs.reach_task import Bools, Float32
from greenhouse_gym.envs.simulation import Ids, ReachSimulation
from greenhouse_gym.envs.tomato_reach import RENDER_MODES, action_space
from greenhouse_gym.errors import InvalidValueError, UnknownNameError, refuse_unknown_keywords, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import SceneBank

Infos = dict[str, Any]


class TomatoReachVectorEnv(VectorEnv[Float32, npt.NDArray[np.float32], npt.NDArray[Any]]):
    """``num_envs`` reaching tasks, stepped together; spaces, rewards and infos are those of `TomatoReachEnv`.

    With seed s, simulation i gives the numbers of a single environment with seed s + i, bit for bit, over resets.
    Infos are dicts of arrays with a mask ``_key`` each, as Gymnasium's vector environments give them.

    Args:
        num_envs: Number of simulations.
        bank, split, robot, observation, action, reward, difficulty, physics, render_mode: As in `TomatoReachEnv`.
        autoreset_mode: An `AutoresetMode` or its value: "NextStep" (the step after an episode's end resets and ignores
            the action), "SameStep" (the ending step resets; the last observation and info are in ``final_obs`` and
            ``final_info``) or "Disabled" (reset with ``options={"reset_mask": (num_envs,) bools}``).
        threads: Threads that simulate; 0 uses all cores. The numbers do not depend on it.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        bank: str | Path | SceneBank = "default",
        split: str = "train",
        robot: str | Path | Robot = "ur5e",
        observation: str = "state",
        action: str = "joint",
        reward: str = "dense",
        difficulty: str | Iterable[str] = ("easy", "medium", "hard"),
        physics: str = "reconstruction",
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 0,
        **unknown: Any,
    ):
        refuse_unknown_keywords(TomatoReachVectorEnv.__init__, unknown)
        if num_envs < 1:
            raise InvalidValueError(f"num_envs must be at least 1, got {num_envs!r}")
        if render_mode is not None:
            require_choice("render mode", render_mode, RENDER_MODES)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = _mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.simulation = ReachSimulation(
            num_envs, bank=bank, split=split, robot=robot, observation=observation, action=action, reward=reward,
            difficulty=difficulty, physics=physics, threads=threads,
        )  # fmt: skip
        self.single_observation_space = self.simulation.observe.space
        self.single_action_space = action_space(self.simulation.robot)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._random: list[np.random.Generator] = [seeding.np_random()[0] for _ in range(num_envs)]
        self._all = np.arange(num_envs)
        self._ended = np.zeros(num_envs, dtype=np.bool_)

    def reset(  # type: ignore[override]
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, Infos]:
        """Begin new episodes in all simulations, or in those of ``options["reset_mask"]``.

        Args:
            seed: s gives simulation i the seed s + i; or one seed (or None) per simulation.
            options: Options of `TomatoReachEnv`, the same for all, and ``reset_mask``, (num_envs,) bools.
        """
        options = dict(options or {})
        chosen = self._all
        if "reset_mask" in options:
            mask = np.asarray(options.pop("reset_mask"))
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
                raise InvalidValueError(f"reset_mask must be {self.num_envs} bools, at least one true, got {mask!r}")
            chosen = np.flatnonzero(mask)
        self._seed(chosen, seed)
        self.simulation.reset(chosen, self._random, options)
        self._ended[chosen] = False
        return self.simulation.observation(), _masked(self.simulation.info(), _mask(self.num_envs, chosen))

    def step(  # type: ignore[override]
        self, actions: Any
    ) -> tuple[Float32, Array, Bools, Bools, Infos]:
        """Act once in every simulation.

        Raises:
            InvalidValueError: The actions have the wrong shape or are not finite, or an ended episode was not reset
                although autoreset is disabled.
        """
        waiting = np.flatnonzero(self._ended)
        if len(waiting) and self.autoreset_mode == AutoresetMode.DISABLED:
            raise InvalidValueError(f"episodes {waiting.tolist()} have ended: reset them first (autoreset is disabled)")
        simulation, everyone = self.simulation, np.ones(self.num_envs, dtype=np.bool_)
        result = simulation.step(actions)
        reward, terminated, truncated = result.reward, result.terminated, result.truncated
        terms = {name: values.copy() for name, values in result.terms.items()}
        if len(waiting):  # only when autoreset happens in the next step
            simulation.reset(waiting, self._random)
            reward[waiting], terminated[waiting], truncated[waiting] = 0.0, False, False
            for values in terms.values():
                values[waiting] = 0.0
        info = simulation.info()
        observations = simulation.observation()
        ended = terminated | truncated
        final: Infos = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and ended.any():
            done = np.flatnonzero(ended)
            final_obs = np.full(self.num_envs, None, dtype=object)
            for i in done:
                final_obs[i] = observations[i].copy()
            final_info = _masked(info, ended) | _nested("reward_terms", terms, ended)
            final = {"final_obs": final_obs, "_final_obs": ended, "final_info": final_info, "_final_info": ended}
            simulation.reset(done, self._random)
            observations[done] = simulation.observation(done)
            info = simulation.info()
            self._ended[:] = False
        else:
            self._ended = ended.copy()
        infos = _masked(info, everyone) | _nested("reward_terms", terms, everyone) | final
        return observations, reward, terminated, truncated, infos

    def render(self) -> tuple[npt.NDArray[np.uint8], ...] | None:  # type: ignore[override]
        """A picture of each simulation, (h, w, 3) uint8; the line to the target in red."""
        if self.render_mode is None:
            return None
        from greenhouse_gym.scene.render import picture

        simulation = self.simulation
        return tuple(
            picture(*simulation.model_and_data(i), simulation.tip(i), simulation.goal(i), samples=1)
            for i in range(self.num_envs)
        )

    def _seed(self, chosen: Ids, seed: int | Sequence[int | None] | None) -> None:
        if seed is None:
            return
        if isinstance(seed, (int, np.integer)):
            seeds: Sequence[int | None] = [int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise InvalidValueError(f"expected {self.num_envs} seeds, got {len(seeds)}")
        for i in chosen:
            if seeds[i] is not None:
                self._random[i], _ = seeding.np_random(seeds[i])


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise UnknownNameError("autoreset mode", mode, [m.value for m in AutoresetMode]) from None


def _mask(count: int, chosen: Ids) -> Bools:
    mask = np.zeros(count, dtype=np.bool_)
    mask[chosen] = True
    return mask


def _masked(values: dict[str, npt.NDArray[Any]], mask: Bools) -> Infos:
    return {**values, **{f"_{key}": mask for key in values}}


def _nested(name: str, values: dict[str, npt.NDArray[Any]], mask: Bools) -> Infos:
    return {name: _masked(values, mask), f"_{name}": mask}
