"""Stable-Baselines3: its `VecEnv` over the native vector environment, and its models as agents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents import Problem
from greenhouse_gym.envs import EnvSettings, GreenhouseVectorEnv, make_vec_env
from greenhouse_gym.envs.observations import Observed
from greenhouse_gym.envs.simulation import Simulation
from greenhouse_gym.errors import InvalidValueError, MissingDependencyError
from greenhouse_gym.learning.sb3_steps import Stepped, Steps

try:
    from stable_baselines3.common.vec_env import VecEnv, VecMonitor
except ImportError as error:  # pragma: no cover - depends on the installation
    raise MissingDependencyError("stable-baselines3", "train") from error


class Sb3Agent:
    """Any model of Stable-Baselines3 as an `greenhouse_gym.agents.Agent`, one with a memory (sb3-contrib's) too.

    Observations are normalized as a ``VecNormalize`` around the model's environment does.

    Args:
        model: The model, trained or loaded.
        name: How it is called in tables; the class of the model when left out.
        env_options: Keywords for `gymnasium.make`; those of the model's environment when left out.
        deterministic: Whether to take the most likely action, or to draw one.
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
        known = {} if simulation is None else simulation.env_options
        self.env_options: Mapping[str, Any] = known if env_options is None else env_options
        self._deterministic = deterministic
        self._memory: Any = None
        self._first = True
        if not hasattr(model.policy, "lstm_actor"):
            self.act_many = self._predict

    def reset(self, problem: Problem) -> None:
        """Forget the last episode."""
        self._memory, self._first = None, True

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """The model's action, (size,)."""
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


def simulation_of(model: Any) -> Simulation | None:
    """The simulation of the environment that a model of Stable-Baselines3 is trained on; None without any of ours."""
    env = model.get_env()
    try:
        return None if env is None else env.get_attr("simulation")[0]
    except AttributeError:
        return None


class Sb3VecEnv(VecEnv):  # type: ignore[misc]
    """A `GreenhouseVectorEnv` with autoreset in the same step, as Stable-Baselines3 wants it.

    Infos are empty except at an episode's end, where they hold ``terminal_observation``, ``TimeLimit.truncated``,
    ``is_success``, the environment's other keys, and ``episode_terms``, the sums of the reward's terms by name. Goal
    environments give whole infos at every step, which ``HerReplayBuffer(copy_info_dict=True)`` needs.
    """

    def __init__(self, env: GreenhouseVectorEnv):
        self.env = env  # first: the base class asks for the render mode
        self._steps = Steps(env)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions: npt.NDArray[np.float32] | None = None

    def reset(self) -> Observed:
        """Begin new episodes everywhere and return the observations (n, size)."""
        observations, self.reset_infos = self._steps.begin(self._seeds, self._options)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: npt.NDArray[np.float32]) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Stepped:
        """Act once everywhere; episodes that end begin anew."""
        return self._steps.act(self._actions)

    def close(self) -> None:
        """Free the simulations."""
        self.env.close()

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """A picture of each simulation."""
        return self.env.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The vector environment's attribute, once per index."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vector environment, which all simulations share.

        Raises:
            InvalidValueError: Only some of the simulations are meant.
        """
        self._require_all(f"attribute {attr_name!r}", indices)
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the vector environment once and give the result for every index.

        Raises:
            InvalidValueError: Only some of the simulations are meant, and the method does more than compute.
        """
        if not method_name.startswith("compute_"):
            self._require_all(f"method {method_name!r}", indices)
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def _require_all(self, what: str, indices: Any) -> None:
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise InvalidValueError(
                f"{what} belongs to all {self.num_envs} simulations together, got indices {indices!r}; leave them out"
            )

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """No simulation is wrapped."""
        return [False for _ in self._get_indices(indices)]


def make_sb3_vec_env(
    num_envs: int = 128,
    settings: EnvSettings | None = None,
    *,
    render_mode: str | None = None,
    threads: int = 0,
    seed: int | None = None,
    **fields: Any,
) -> VecMonitor:
    """The vector environment for Stable-Baselines3, with episode returns and lengths recorded.

    Args:
        num_envs: Number of simulations.
        settings: What they are made of; the usual `EnvSettings` when left out.
        render_mode: How `render` shows it.
        threads: Threads that simulate.
        seed: Seeds the simulations' generators with seed + i at the first reset.
        **fields: Fields of `EnvSettings`, as in `GreenhouseEnv`.
    """
    env = make_vec_env(
        num_envs, settings, render_mode=render_mode, autoreset_mode="SameStep", threads=threads, **fields
    )
    wrapped = Sb3VecEnv(env)
    if seed is not None:
        wrapped.seed(seed)
    return VecMonitor(wrapped)
