"""Bridge to Stable-Baselines3: its `VecEnv` over the vector environments, and its models as agents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv

from greenhouse_gym.agents import Problem
from greenhouse_gym.agents.agent import NamedAgent
from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs import EnvSettings, make_vec
from greenhouse_gym.envs.observations import Observed
from greenhouse_gym.errors import InvalidValueError

with needs("train"):
    from stable_baselines3.common.vec_env import VecEnv, VecMonitor

TERMS = "episode_terms"
"""Key of the info at an episode's end that holds the sums of the reward's terms over the episode, by name."""


class Sb3Agent(NamedAgent):
    """Model of Stable-Baselines3 or a recurrent one of sb3-contrib as a `greenhouse_gym.agents.Agent`.

    Observations are normalized as by a ``VecNormalize`` around the model's environment.

    Args:
        model: The model, trained or loaded.
        name: Name in tables; the class of the model when left out.
        env_options: Keywords for `gymnasium.make`; those of the model's environment when left out.
        deterministic: True to take the most likely action, False to sample one.
    """

    def __init__(
        self,
        model: Any,
        name: str | None = None,
        env_options: Mapping[str, Any] | None = None,
        deterministic: bool = True,
    ):
        self.name = name or type(model).__name__
        self.model = model
        simulation = simulation_of(model)
        options = {} if simulation is None else simulation.settings.agent_options()
        self.env_options: Mapping[str, Any] = options if env_options is None else env_options
        self._deterministic = deterministic
        self._memory: Any = None
        self._first = True
        if not hasattr(model.policy, "lstm_actor"):
            self.act_many = self._predict

    def reset(self, problem: Problem) -> None:
        """Clear the memory of a recurrent model."""
        self._memory, self._first = None, True

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """Return the model's action, (size,)."""
        return self._predict(observation)

    def _predict(self, observations: Any) -> npt.NDArray[np.float32]:
        normalizer = self.model.get_vec_normalize_env()
        if normalizer is not None:
            observations = normalizer.normalize_obs(observations)
        actions, self._memory = self.model.predict(
            observations, self._memory, np.array([self._first]), deterministic=self._deterministic
        )
        self._first = False
        return np.asarray(actions)

    def __deepcopy__(self, memo: dict[int, Any]) -> Sb3Agent:
        return Sb3Agent(self.model, self.name, self.env_options, self._deterministic)


def simulation_of(model: Any) -> Any:
    """Return the simulation of a Stable-Baselines3 model's environment; None if that is not of this package."""
    env = model.get_env()
    try:
        return None if env is None else env.get_attr("simulation")[0]
    except AttributeError:
        return None


class Sb3VecEnv(VecEnv):  # type: ignore[misc]
    """An environment of `make_vec` with NumPy arrays and autoreset in the same step, as Stable-Baselines3 requires.

    Infos are empty except at an episode's end, where they contain ``terminal_observation``, ``TimeLimit.truncated``,
    ``is_success``, the environment's other keys, and ``episode_terms``, the sums of the reward's terms by name. Goal
    environments return whole infos at every step, which ``HerReplayBuffer(copy_info_dict=True)`` needs.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]):
        self.env: Any = env  # before the base class, which reads the render mode
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions: Any = None
        self._term_sums: dict[str, npt.NDArray[np.float64]] = {}  # of the running episodes

    def reset(self) -> Observed:
        """Start new episodes in all simulations and return the observations (n, size)."""
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds  # given after `seed` only
        observations, infos = self.env.reset(seed=seeds, options=self._options)
        self.reset_infos = [_info(infos, i) for i in range(self.num_envs)]
        self._term_sums = {}
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: npt.NDArray[np.float32]) -> None:
        """Store the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Observed, npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all simulations; those whose episode ends start a new one."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        dones = terminated | truncated
        for part in (infos, infos.get("final_info", {})):
            for name, values in part.get("reward_terms", {}).items():
                if not name.startswith("_"):
                    self._term_sums[name] = self._term_sums.get(name, 0.0) + values * part["_reward_terms"]
        has_goals = self.env.simulation.observe.has_goals
        single = [_info(infos, i) if has_goals else {} for i in range(self.num_envs)]
        for i in np.flatnonzero(dones).tolist():
            single[i] = _info(infos["final_info"], i)
            single[i]["terminal_observation"] = infos["final_obs"][i]
            single[i]["TimeLimit.truncated"] = bool(truncated[i])
            single[i][TERMS] = {name: float(sums[i]) for name, sums in self._term_sums.items()}
        for sums in self._term_sums.values():
            sums[dones] = 0.0
        return observations, rewards.astype(np.float32), dones, single

    def close(self) -> None:
        """Release the simulations."""
        self.env.close()

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """Return a picture of each simulation."""
        return (self.env.render() if self.render_mode else None) or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the vector environment's attribute, once per index."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vector environment, which all simulations share.

        Raises:
            InvalidValueError: The indices select only some of the simulations.
        """
        self._require_all(f"attribute {attr_name!r}", indices)
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the vector environment once and return the result for every index.

        Raises:
            InvalidValueError: The indices select only some of the simulations for a method that changes state.
        """
        if not method_name.startswith("compute_"):
            self._require_all(f"method {method_name!r}", indices)
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def _require_all(self, name: str, indices: Any) -> None:
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise InvalidValueError(
                f"{name} belongs to all {self.num_envs} simulations together, got indices {indices!r}; leave them out"
            )

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return False for every index: simulations are never wrapped."""
        return [False for _ in self._get_indices(indices)]


def make_sb3_vec_env(
    num_envs: int = 128,
    settings: EnvSettings | None = None,
    *,
    backend: str = "mujoco",
    render_mode: str | None = None,
    threads: int = 0,
    seed: int | None = None,
    **fields: Any,
) -> VecMonitor:
    """Make the vector environment for Stable-Baselines3, with episode returns and lengths recorded.

    Args:
        num_envs: Number of simulations.
        settings: Settings of the environment; the default `EnvSettings` when left out.
        backend: "mujoco" or "warp", as for `make_vec`; "warp" steps about ten times as fast on a CPU.
        render_mode: Render mode of the environment.
        threads: Threads of the simulation; 0 uses all cores. With "warp" it has one.
        seed: Seed of the first simulation's generator at the first reset; simulation i gets seed + i.
        **fields: Fields of `EnvSettings`, as in `GreenhouseEnv`, and with "warp" further keywords of `WarpVectorEnv`.
    """
    options = fields if backend == "warp" else {"threads": threads, **fields}
    env = make_vec(
        num_envs, backend=backend, settings=settings, render_mode=render_mode, autoreset_mode="SameStep", **options
    )
    wrapped = Sb3VecEnv(env)
    if seed is not None:
        wrapped.seed(seed)
    return VecMonitor(wrapped)


def _info(infos: dict[str, Any], i: int) -> dict[str, Any]:
    """Extract one simulation's info from the vector environment's."""
    result: dict[str, Any] = {}
    for key, values in infos.items():
        mask = infos.get(f"_{key}")  # of nested infos only with MuJoCo
        if key.startswith(("_", "final_")) or not (mask is None or mask[i]):
            continue
        if isinstance(values, dict):
            result[key] = _info(values, i)
        else:
            result[key] = values[i] if values.dtype == object or values.ndim > 1 else values[i].item()
    return result
