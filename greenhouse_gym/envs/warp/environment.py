"""The vector environment whose simulations run as kernels on a CPU or a GPU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs.actions import check_actions
from greenhouse_gym.envs.choices import step_limit_of
from greenhouse_gym.envs.episodes import DifficultyChoice
from greenhouse_gym.envs.settings import EnvSettings, settings_with
from greenhouse_gym.envs.specification import EnvMixin
from greenhouse_gym.envs.vector import mode_of
from greenhouse_gym.envs.warp.simulation import TERMS, WarpSimulation
from greenhouse_gym.errors import InvalidValueError, NoEpisodeError, check_whole, require_choice

ARRAYS = ("numpy", "torch")
"""Kinds of arrays that an environment returns."""

_INFOS = {
    "is_success": "success", "collision": "collision", "contact": "contact", "distance": "distance",
    "clearance": "clearance", "scene": "scene", "target": "target", "difficulty": "difficulty",
}  # fmt: skip
_COUNTS = ("steps", "speed_limited", "position_limited")


class WarpVectorEnv(EnvMixin, VectorEnv[Any, Any, Any]):  # type: ignore[misc]
    """``num_envs`` simulations as kernels: the numbers of `GreenhouseVectorEnv`, up to rounding, from another device.

    The scenes of the split, their distance fields, the draws of episodes and the resets are on the device, and a step
    waits for nothing, so it can be captured in a CUDA graph. Contacts end episodes, and push nothing. Supported are the
    task "reach", arms of hinges whose parts are capsules or spheres, the observations "state" and "goal", all three
    kinds of actions, and the rewards "dense" and "sparse"; other settings raise an error. All scenes of the split are
    drawn from, also of a large bank.

    With seed s, simulation i draws the episodes of a single simulation with seed s + i; the other backend draws others.

    Infos have the keys of `GreenhouseEnv` as arrays (n, ...), with a mask ``_key`` each. Names are indices: ``scene``
    into `scene_names`, ``difficulty`` into `RATINGS`, and ``contact`` (n, 2) holds an arm's part and its counterpart,
    which `contact_names` names. ``reward_terms`` holds arrays by name. Contacts are not counted by group. With
    autoreset in the same step, ``final_obs`` and ``final_info`` hold arrays of all simulations as well, with masks of
    those whose episode has ended.

    Args:
        num_envs: Number of simulations.
        settings: The settings; default `EnvSettings` if None.
        device: "cpu" or "cuda"; "cuda:1" is the second GPU.
        arrays: "numpy", or "torch" for tensors on the device without copies: they change with the next step.
        precision: "float32" or "float64"; by default single precision on a GPU and double precision on a CPU.
        autoreset_mode: "NextStep" or "SameStep", as in `GreenhouseVectorEnv`.
        render_mode: None; images need the other backend.
        max_episode_steps: Step limit below that of the settings.
        **fields: Fields of `EnvSettings`, which replace those of ``settings``.

    Attributes:
        target_rows: (n,) rows of the current tomatoes in ``simulation.bank.arrays``, a tensor that changes with each
            step; None unless tensors are returned.
        episode_steps: (n,) steps of the current episodes, likewise.

    Raises:
        MissingDependencyError: Warp, or torch for tensors, is not installed.
        InvalidValueError: A setting is not supported, or the device is missing or lacks memory; the message names the
            way out.
    """

    metadata = {"render_modes": [], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        settings: EnvSettings | None = None,
        *,
        device: str = "cpu",
        arrays: str = "numpy",
        precision: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **fields: Any,
    ):
        self.settings = settings_with("WarpVectorEnv", settings, fields)
        if max_episode_steps is not None:
            limit = check_whole("max_episode_steps", max_episode_steps, 1, step_limit_of(self.settings))
            self.settings = replace(self.settings, step_limit=limit)
        self.num_envs = num_envs = check_whole("num_envs", num_envs, 1)
        if render_mode is not None:
            raise InvalidValueError(f'backend="warp" draws no images, got render_mode={render_mode!r}: choose None')
        self.render_mode = None
        self.autoreset_mode = mode_of(autoreset_mode)
        if self.autoreset_mode == AutoresetMode.DISABLED:
            raise InvalidValueError('backend="warp" resets by itself: choose autoreset_mode "NextStep" or "SameStep"')
        self.options = {
            "num_envs": num_envs, "device": device, "arrays": arrays, "precision": precision,
            "autoreset_mode": self.autoreset_mode.value,
        }  # fmt: skip
        self.metadata = {**self.metadata, "render_fps": self.settings.rate, "autoreset_mode": self.autoreset_mode}
        self._torch = _torch() if require_choice("arrays", arrays, ARRAYS) == "torch" else None
        self.simulation = simulation = WarpSimulation(num_envs, self.settings, device, precision)
        self.single_observation_space = simulation.observe.space
        self.single_action_space = simulation.action_rule.space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rng = np.random.default_rng()
        self._began = False
        self._streams: dict[int, Any] = {}
        state, out = simulation.state, simulation.out
        state.seed.assign(self._rng.integers(2**31, size=num_envs).astype(np.int32))
        if simulation.observe.has_goals:
            self._observed = {
                "achieved_goal": out.achieved, "desired_goal": out.desired, "observation": out.observation
            }  # fmt: skip
        else:
            self._observed = {"": out.observation}
        self._info = {key: getattr(out, name) for key, name in _INFOS.items()} | {k: getattr(state, k) for k in _COUNTS}
        self._final = {
            key: wp.clone(array) for key, array in (self._observed | self._info).items()
        } if self.autoreset_mode == AutoresetMode.SAME_STEP else {}  # fmt: skip
        self.target_rows: Any = None
        self.episode_steps: Any = None
        if self._torch is not None:
            self.target_rows, self.episode_steps = wp.to_torch(state.row), wp.to_torch(state.steps)
            self._action = wp.to_torch(simulation.action)
            self._tensors = {
                id(array): wp.to_torch(array)
                for array in (
                    *self._observed.values(), *self._info.values(), *self._final.values(),
                    out.reward, out.terms, out.terminated, out.truncated, out.ended,
                )
            }  # fmt: skip
            self._everyone = self._torch.ones(num_envs, dtype=self._torch.bool, device=self._action.device)
        else:
            self._everyone = np.ones(num_envs, dtype=np.bool_)

    @property
    def scene_names(self) -> list[str]:
        """Names of the scenes, by index."""
        return list(self.simulation.bank.index)

    def contact_names(self, i: int) -> tuple[str, str]:
        """Return the names of the first contact of a simulation's last step, the arm's first; empty without one."""
        out = self.simulation.out
        part, counterpart = out.contact.numpy()[i].tolist()
        return self.simulation.contact_names(part, counterpart, int(out.scene.numpy()[i]))

    def set_difficulty(self, difficulty: DifficultyChoice) -> None:
        """Set the difficulties of targets from the next episodes on, see `EnvSettings.difficulty`."""
        self.simulation.sampler.set_difficulty(difficulty)
        self.simulation.set_draws()

    def reset(  # type: ignore[override]
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | Sequence[dict[str, Any] | None] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin new episodes in all simulations, or in those of ``options["reset_mask"]``.

        Args:
            seed: A seed s gives simulation i the seed s + i; or a list with a seed (or None) for each simulation.
            options: Options of `GreenhouseEnv` for all simulations, and ``reset_mask``; or a list with options (or
                None) for each simulation. Scenes must belong to the environment's split.
        """
        state, count = self.simulation.state, self.num_envs
        mask = np.ones(count, dtype=np.bool_)
        if isinstance(options, dict) and "reset_mask" in options:
            options = dict(options)
            mask = np.asarray(options.pop("reset_mask"))
            if mask.shape != (count,) or mask.dtype != np.bool_ or not mask.any():
                raise InvalidValueError(f"reset_mask must be {count} bools, at least one true, got {mask!r}")
        if not self._began and not mask.all():
            raise NoEpisodeError("there is no episode yet: reset the whole environment first")
        each: Any = options if isinstance(options, (list, tuple)) else [options] * count
        if len(each) != count:
            raise InvalidValueError(f"expected options for {count} simulations, got {len(each)}")
        self._seed(mask, seed)
        self._choose(np.flatnonzero(mask), each)
        waiting = state.ended.numpy().astype(np.bool_) & ~mask
        state.ended.assign(mask.astype(np.int32))
        wp.synchronize_device(self.simulation.device)  # what was assigned is on another stream
        self.simulation.launch(resets_only=True, stream=self._stream())
        wp.synchronize_device(self.simulation.device)
        state.ended.assign(waiting.astype(np.int32))
        self._began = True
        return self._observation(self._observed), self._infos(self._info, self._everyone)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:  # type: ignore[override]
        """Apply an action in every simulation.

        Args:
            actions: (n, size) numbers, or a tensor on any device; entries of a tensor that are not finite count as -1.

        Raises:
            InvalidValueError: The actions have the wrong shape or, unless they are a tensor, are not finite.
        """
        if not self._began:
            raise NoEpisodeError("there is no episode yet: reset the whole environment first")
        self._take(actions)
        stream, simulation = self._stream(), self.simulation
        simulation.launch(stream=stream)
        out = simulation.out
        same_step = self.autoreset_mode == AutoresetMode.SAME_STEP
        if same_step:
            for key, array in (self._observed | self._info).items():
                wp.copy(self._final[key], array, stream=stream)
            simulation.launch(resets_only=True, stream=stream)
        terms = dict(zip(TERMS, self._array(out.terms).T, strict=True))
        infos = self._infos(self._info, self._everyone) | {"reward_terms": terms, "_reward_terms": self._everyone}
        if same_step:
            ended = self._array(out.ended)
            final = {"reward_terms": terms, "_reward_terms": ended}
            infos |= {
                "_reward_terms": ~ended,  # the others have the info of a reset
                "final_obs": self._observation({key: self._final[key] for key in self._observed}), "_final_obs": ended,
                "final_info": self._infos({key: self._final[key] for key in self._info}, ended) | final,
                "_final_info": ended,
            }  # fmt: skip
        observation = self._observation(self._observed)
        reward, terminated, truncated = (self._array(array) for array in (out.reward, out.terminated, out.truncated))
        return observation, reward, terminated, truncated, infos

    def _take(self, actions: Any) -> None:
        simulation = self.simulation
        if type(actions).__module__.partition(".")[0] == "torch":
            shape = tuple(simulation.action.shape)
            if tuple(actions.shape) != shape:
                raise InvalidValueError(f"an action must have shape {shape}, got {tuple(actions.shape)}")
            if self._torch is not None:
                self._action.copy_(actions)
                return
            actions = actions.detach().cpu().numpy()
        simulation.action.assign(check_actions(actions, self.num_envs, simulation.action_rule.space).astype(np.float32))

    def _stream(self) -> Any:
        """Return torch's current stream if tensors are returned, so that its work before and after is in order."""
        if self._torch is None or not self.simulation.device.is_cuda:
            return None
        current = self._torch.cuda.current_stream(self._action.device)
        if current.cuda_stream not in self._streams:
            self._streams[current.cuda_stream] = wp.stream_from_torch(current)
        return self._streams[current.cuda_stream]

    def _seed(self, mask: npt.NDArray[np.bool_], seed: int | Sequence[int | None] | None) -> None:
        if seed is None:
            return
        count, state = self.num_envs, self.simulation.state
        seeds = [int(seed) + i for i in range(count)] if isinstance(seed, (int, np.integer)) else list(seed)
        if len(seeds) != count:
            raise InvalidValueError(f"expected {count} seeds, got {len(seeds)}")
        given = np.array([one is not None for one in seeds]) & mask
        new = np.array([(one or 0) % 2**31 for one in seeds], dtype=np.int32)
        state.seed.assign(np.where(given, new, state.seed.numpy()))
        state.draws.assign(np.where(given, 0, state.draws.numpy()).astype(np.int32))
        self._rng = np.random.default_rng(int(new[given][0]) if given.any() else None)

    def _choose(self, ids: npt.NDArray[np.int64], options: Sequence[dict[str, Any] | None]) -> None:
        """Let the options of a reset choose tomatoes and starts."""
        simulation = self.simulation
        if not any(options[i] for i in ids):
            return
        state, sampler, first = simulation.state, simulation.sampler, simulation.bank.arrays.tomato_first
        wanted, start = state.wanted.numpy().copy(), state.start.numpy().copy()
        for i in ids:
            if options[i]:
                episode = sampler.draw(self._rng, options[i])
                index = simulation.bank.index_of(episode.scene, self.settings.split)
                wanted[i] = first[index] + episode.targets[0]
                start[i] = np.nan if options[i].get("start") is None else episode.start
        state.wanted.assign(wanted)
        state.start.assign(start)

    def _array(self, array: Any) -> Any:
        if self._torch is not None:
            return self._tensors[id(array)]
        values = array.numpy()
        return values if self.simulation.device.is_cuda else values.copy()

    def _observation(self, arrays: dict[str, Any]) -> Any:
        observed = {key: self._array(array) for key, array in arrays.items()}
        return observed.get("", observed)

    def _infos(self, arrays: dict[str, Any], mask: Any) -> dict[str, Any]:
        infos = {key: self._array(array) for key, array in arrays.items()}
        return infos | {f"_{key}": mask for key in infos}


def _torch() -> Any:
    with needs("train"):
        import torch
    return torch
