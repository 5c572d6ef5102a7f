"""Gymnasium vector environment: many simulations in one `mujoco.batch.Batch`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from greenhouse_gym.envs.choices import step_limit_of
from greenhouse_gym.envs.contacts import CONTACT_GROUPS
from greenhouse_gym.envs.episodes import DifficultyChoice
from greenhouse_gym.envs.hindsight import add_goal_functions
from greenhouse_gym.envs.infos import Infos, masked, numbers_only
from greenhouse_gym.envs.observations import Observed, select
from greenhouse_gym.envs.rewards import StepResult
from greenhouse_gym.envs.settings import EnvSettings, settings_with
from greenhouse_gym.envs.simulation import Simulation
from greenhouse_gym.envs.specification import EnvMixin
from greenhouse_gym.envs.state import Bools, Ids
from greenhouse_gym.errors import (
    EpisodeOverError,
    InvalidValueError,
    UnknownNameError,
    check_whole,
    require_choice,
    require_seed,
)
from greenhouse_gym.geometry import Array
from greenhouse_gym.rendering.renderer import Viewpoint
from greenhouse_gym.rendering.viewer import RENDER_MODES, Picture, Viewer, available_modes

MAX_THREADS = 1024
"""Largest number of threads of a simulation."""


class GreenhouseVectorEnv(  # type: ignore[misc]
    EnvMixin, VectorEnv[Observed, npt.NDArray[np.float32], npt.NDArray[Any]]
):
    """``num_envs`` simulations, stepped together; spaces, rewards and infos are those of `GreenhouseEnv`.

    With seed s, simulation i computes the numbers of a single environment with seed s + i, bit for bit, across resets.
    Infos are dicts of arrays with a mask ``_key`` each, as in Gymnasium's vector environments.

    Args:
        num_envs: Number of simulations.
        settings: The settings; default `EnvSettings` if None.
        render_mode: As in `GreenhouseEnv`.
        autoreset_mode: An `AutoresetMode` or its value: "NextStep" (the step after an episode's end resets and ignores
            the action), "SameStep" (the ending step resets; the last observation and info are in ``final_obs`` and
            ``final_info``) or "Disabled" (reset with ``options={"reset_mask": (num_envs,) bools}``).
        threads: Number of simulation threads; 0 uses all cores. Results do not depend on it.
        max_episode_steps: Step limit below that of the settings, as ``gymnasium.make`` has it for the single
            environment.
        width: As in `GreenhouseEnv`.
        height: As in `GreenhouseEnv`.
        camera: As in `GreenhouseEnv`.
        **fields: Fields of `EnvSettings`, which replace those of ``settings``.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        settings: EnvSettings | None = None,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 0,
        max_episode_steps: int | None = None,
        width: int = 640,
        height: int = 480,
        camera: str | Viewpoint = "aisle",
        **fields: Any,
    ):
        self.settings = settings_with("GreenhouseVectorEnv", settings, fields)
        if max_episode_steps is not None:
            limit = check_whole("max_episode_steps", max_episode_steps, 1, step_limit_of(self.settings))
            self.settings = replace(self.settings, step_limit=limit)
        self.num_envs = num_envs = check_whole("num_envs", num_envs, 1, 2**20)
        threads = check_whole("threads", threads, 0, MAX_THREADS)
        self.render_mode = None if render_mode is None else require_choice("render mode", render_mode, RENDER_MODES)
        picture = Picture(width, height, camera)
        if render_mode == "human" and num_envs > 1:
            raise InvalidValueError('render_mode="human" shows one simulation; choose "rgb_array" or num_envs=1')
        self.options = {
            "num_envs": num_envs, "render_mode": render_mode, "autoreset_mode": mode_of(autoreset_mode).value,
            "threads": threads,
        }  # fmt: skip
        if render_mode is not None:
            self.options |= {"width": width, "height": height, "camera": camera}
        self._viewer = None if render_mode is None else Viewer(render_mode, picture)
        self.autoreset_mode = mode_of(autoreset_mode)
        self.metadata = {
            "render_modes": available_modes(), "render_fps": self.settings.rate,
            "autoreset_mode": self.autoreset_mode,
        }  # fmt: skip
        self.simulation = Simulation(num_envs, self.settings, threads)
        self.single_observation_space = self.simulation.observe.space
        self.single_action_space = self.simulation.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        add_goal_functions(self)
        self._rngs: list[np.random.Generator] = [seeding.np_random()[0] for _ in range(num_envs)]
        self._all = np.arange(num_envs)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._no_options = [None] * num_envs

    def reset(  # type: ignore[override]
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | Sequence[dict[str, Any] | None] | None = None,
    ) -> tuple[Observed, Infos]:
        """Begin new episodes in all simulations, or in those of ``options["reset_mask"]``.

        Args:
            seed: A seed s gives simulation i the seed s + i; or a list with a seed (or None) for each simulation.
            options: Options of `GreenhouseEnv` for all simulations, and ``reset_mask``, (num_envs,) bools; or a list
                with options (or None) for each simulation.
        """
        chosen = self._all
        if isinstance(options, dict) and "reset_mask" in options:
            options = dict(options)
            mask = np.asarray(options.pop("reset_mask"))
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
                raise InvalidValueError(f"reset_mask must be {self.num_envs} bools, at least one true, got {mask!r}")
            chosen = np.flatnonzero(mask)
        self._seed(chosen, seed)
        each = options if isinstance(options, (list, tuple)) else [options] * self.num_envs
        if len(each) != self.num_envs:
            raise InvalidValueError(f"expected options for {self.num_envs} simulations, got {len(each)}")
        self.simulation.reset(chosen, self._rngs, each)  # type: ignore[arg-type]
        self._ended[chosen] = False
        mask = _mask(self.num_envs, chosen)
        return self.simulation.observation(), masked(self._info(None), mask, mask)

    def step(  # type: ignore[override]
        self, actions: Any
    ) -> tuple[Observed, Array, Bools, Bools, Infos]:
        """Apply an action in every simulation.

        Raises:
            InvalidValueError: The actions have the wrong shape or are not finite.
            EpisodeOverError: Autoreset is disabled and an ended episode was not reset.
        """
        waiting = np.flatnonzero(self._ended)
        if len(waiting) and self.autoreset_mode == AutoresetMode.DISABLED:
            raise EpisodeOverError(f"episodes {waiting.tolist()} have ended: reset them first (autoreset is disabled)")
        simulation, everyone = self.simulation, np.ones(self.num_envs, dtype=np.bool_)
        result = simulation.step(actions)
        reward, terminated, truncated = result.reward, result.terminated, result.truncated
        terms = self._shown({"reward_terms": dict(result.terms)})
        if len(waiting):  # with autoreset in the next step
            simulation.reset(waiting, self._rngs, self._no_options)
            reward[waiting], terminated[waiting], truncated[waiting] = 0.0, False, False
        info = self._info(result)
        observations = simulation.observation()
        ended = terminated | truncated
        final: Infos = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and ended.any():
            done = np.flatnonzero(ended)
            final_obs = np.full(self.num_envs, None, dtype=object)
            for i in done:
                final_obs[i] = _copied(select(observations, i))
            final_info = masked(info, ended, ended) | masked(terms, ended, ended)
            final = {"final_obs": final_obs, "_final_obs": ended, "final_info": final_info, "_final_info": ended}
            simulation.reset(done, self._rngs, self._no_options)
            _replace(observations, done, simulation.observation(done))
            info = self._info(result)
            self._ended[:] = False
        else:
            self._ended = ended.copy()
        # simulations whose episode has just begun have no info of a step
        stepped = ~(ended if final else _mask(self.num_envs, waiting))
        infos = masked(info, everyone, stepped) | masked(terms, stepped, stepped) | final
        return observations, reward, terminated, truncated, infos

    def set_difficulty(self, difficulty: DifficultyChoice) -> None:
        """Set the difficulties of targets from each simulation's next reset on, see `EnvSettings.difficulty`."""
        self.simulation.sampler.set_difficulty(difficulty)

    def render(self) -> tuple[npt.NDArray[Any] | None, ...] | None:  # type: ignore[override]
        """Return the image of each simulation, as `GreenhouseEnv.render` does, without the tip's path."""
        if self._viewer is None:
            return None
        simulation, viewer = self.simulation, self._viewer
        return tuple(
            viewer.draw(
                *simulation.model_and_data(i),
                simulation.episode(i).scene.placement,
                simulation.tip(i),
                simulation.goal(i),
                [],
            )
            for i in range(self.num_envs)
        )

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulations."""
        self.simulation.close()
        if self._viewer:
            self._viewer.close()

    def _info(self, result: StepResult | None) -> Infos:
        info: Infos = {key: values.copy() for key, values in self.simulation.info(result).items()}
        return self._shown(info | {"contacts": dict(zip(CONTACT_GROUPS, info["contacts"].T, strict=True))})

    def _shown(self, infos: Infos) -> Infos:
        return numbers_only(infos) if self.settings.infos == "numbers" else infos

    def _seed(self, chosen: Ids, seed: int | Sequence[int | None] | None) -> None:
        if seed is None:
            return
        if isinstance(seed, (int, np.integer)):
            seeds: Sequence[int | None] = [int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise InvalidValueError(f"expected {self.num_envs} seeds, got {len(seeds)}")
        given = {int(i): require_seed(seed) for i in chosen if (seed := seeds[i]) is not None}
        for i, own in given.items():
            self._rngs[i], _ = seeding.np_random(own)
        if given:
            self.simulation.sampler.restart(next(iter(given.values())))


def mode_of(mode: AutoresetMode | str) -> AutoresetMode:
    """Return an autoreset mode by its value.

    Raises:
        UnknownNameError: There is no such mode.
    """
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise UnknownNameError("autoreset mode", mode, [m.value for m in AutoresetMode]) from None


def _mask(count: int, chosen: Ids) -> Bools:
    mask = np.zeros(count, dtype=np.bool_)
    mask[chosen] = True
    return mask


def _copied(observed: Observed) -> Observed:
    return {key: values.copy() for key, values in observed.items()} if isinstance(observed, dict) else observed.copy()


def _replace(observed: Observed, ids: Ids, fresh: Observed) -> None:
    """Replace the observations of some simulations by fresh ones."""
    if isinstance(observed, dict):
        assert isinstance(fresh, dict)
        for key, values in observed.items():
            values[ids] = fresh[key]
    else:
        observed[ids] = fresh
