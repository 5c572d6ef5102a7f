"""The single environment."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.reach_task import Float32
from greenhouse_gym.envs.simulation import ReachSimulation, StepResult
from greenhouse_gym.errors import refuse_unknown_keywords, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene, SceneBank

RENDER_MODES = ("rgb_array",)
_ONLY = np.array([0])


class TomatoReachEnv(gymnasium.Env[Float32, npt.NDArray[np.float32]]):
    """Reach a tomato with the tool of an arm, and touch nothing else.

    An episode takes place in one scene of a bank, with one of its tomatoes as the target. The arm carries a slender
    suction gripper; its *tip* is the middle of the cup, and the *grasp point* lies one target radius ahead of the tip
    along the tool.

    **Frame.** Positions are in the frame of the arm's base: x forward to the plants, y left along the row, z up.

    **Action** ``Box(-1, 1, (joints,), float32)``. Each entry adds up to 0.08 rad to the joint's last command, which
    stays within the joint limits and within 0.2 rad of the measured joint. 20 actions per second; the servos follow a
    ramp to the new command. Values beyond [-1, 1] are clipped; anything that is not finite is an error.

    **Observation** ``state``, ``Box((60,), float32)`` for ``ur5e`` (j = 6 joints, k = 9 probe points):

    | index | meaning | bounds | unit |
    |---|---|---|---|
    | 0 to 5 | joint positions | joint limits widened by 0.1 | rad |
    | 6 to 11 | joint velocities | twice the speed limits, +-6.28 | rad/s |
    | 12 to 17 | command minus joint position | +-0.4 | rad |
    | 18 to 20 | from the grasp point to the target's center | +-3 | m |
    | 21 to 23 | the target's center | +-3 | m |
    | 24 to 32 | clearance of the arm's surface at the probe points, arm to tip | -0.1 to 0.3 | m |
    | 33 to 59 | unit vectors from the probe points to the nearest obstacle, x y z each; 0 beyond 0.3 m | +-1 | |

    In general: j + j + j + 3 + 3 + k + 3 k entries. Obstacles here are stems, clutter and all tomatoes but the target,
    not the floor, the cart or the arm itself. Tomatoes are exact; stems and clutter are read from a distance field with
    nodes 2 cm apart (mean error 1 mm, at most 1 cm). Values beyond a bound are clipped to it.

    **Success.** The grasp point is within 2 cm of the target's center and nothing was touched in any physics step of
    the action. The cup may touch the target. Any other contact is a **collision**. Both terminate the episode; after
    200 steps it is truncated (by the environment itself, there is no `TimeLimit` wrapper).

    **Reward.** ``dense``: success +10, collision -1, progress 4 * (decrease of the distance, m), time -0.02, effort
    -0.003 |action|^2. ``sparse``: success +1, collision -1. The terms are in ``info["reward_terms"]`` and sum to the
    reward.

    **Info**, on reset and step: ``is_success``, ``collision`` (bool), ``contact`` (names of the two geoms, the arm's
    first, or empty), ``distance`` (grasp point to the target's center, m), ``clearance`` (the smallest of the observed
    ones before clipping, m), ``scene`` (name), ``target`` (index of the tomato), ``difficulty``; on step also
    ``reward_terms``.

    **Reset options**: ``scene`` (a name of any split, or a `Scene`), ``target`` (index of any of its tomatoes),
    ``start`` (joint angles, rad; default the robot's start). A start that touches something is a collision at the
    first step.

    Args:
        bank: Name of a shipped bank, folder of one, or a `SceneBank`.
        split: "train", "validation" or "test".
        robot: Name of a shipped arm, or an MJCF file.
        observation: "state".
        action: "joint".
        reward: "dense" or "sparse".
        difficulty: Difficulties to draw targets from; "unreachable" only if named.
        physics: "reconstruction"; with "truth" the simulated row behind the scene is what is touched and reached (the
            true tomato nearest to the target), while observations tell only of the reconstruction.
        render_mode: "rgb_array" or None.

    Raises:
        UnknownNameError: A name is not among the choices; the message lists them.
        UnknownKeywordError: A keyword does not exist; the message lists those that do.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        bank: str | Path | SceneBank = "default",
        split: str = "train",
        robot: str | Path | Robot = "ur5e",
        observation: str = "state",
        action: str = "joint",
        reward: str = "dense",
        difficulty: str | Iterable[str] = ("easy", "medium", "hard"),
        physics: str = "reconstruction",
        render_mode: str | None = None,
        **unknown: Any,
    ):
        refuse_unknown_keywords(TomatoReachEnv.__init__, unknown)
        if render_mode is not None:
            require_choice("render mode", render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self.simulation = ReachSimulation(
            1, bank=bank, split=split, robot=robot, observation=observation, action=action, reward=reward,
            difficulty=difficulty, physics=physics, threads=1,
        )  # fmt: skip
        self.observation_space = self.simulation.observe.space
        self.action_space = action_space(self.simulation.robot)
        self._tip_trace: list[Array] = []

    @property
    def robot(self) -> Robot:
        """The arm."""
        return self.simulation.robot

    @property
    def scene(self) -> Scene:
        """The scene of the current episode."""
        return self.simulation.episode(0).scene

    @property
    def target(self) -> int:
        """Index of the target among the tomatoes of `scene`."""
        return self.simulation.episode(0).target

    @property
    def start(self) -> Array:
        """(joints,) start configuration of the current episode, radians."""
        return self.simulation.episode(0).start

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, dict[str, Any]]:
        """Begin an episode; the class docstring lists the options."""
        super().reset(seed=seed)
        self.simulation.reset(_ONLY, [self.np_random], options)
        self._tip_trace = [self._tip()]
        return self._observation(), self._info(None)

    def step(self, action: Any) -> tuple[Float32, float, bool, bool, dict[str, Any]]:
        """Act once.

        Raises:
            InvalidValueError: The action has the wrong shape or is not finite.
        """
        result = self.simulation.step(np.asarray(action)[None])
        self._tip_trace.append(self._tip())
        reward, terminated, truncated = result.reward.item(), result.terminated.item(), result.truncated.item()
        return self._observation(), reward, terminated, truncated, self._info(result)

    def render(self) -> npt.NDArray[np.uint8] | None:  # type: ignore[override]
        """The arm in front of the plants, (h, w, 3) uint8; the line to the target in red, the tip's trace in pink."""
        if self.render_mode is None:
            return None
        from greenhouse_gym.scene.render import picture

        model, data = self.model_and_data()
        goal = self.simulation.goal(0)
        return picture(model, data, self._tip(), goal, self._tip_trace, samples=1)

    def model_and_data(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """A copy of the episode's MuJoCo model and its current state, to look at or to compute with."""
        return self.simulation.model_and_data(0)

    def _observation(self) -> Float32:
        return self.simulation.observation()[0]

    def _info(self, result: StepResult | None) -> dict[str, Any]:
        info = {key: _item(values) for key, values in self.simulation.info().items()}
        if result is not None:
            info["reward_terms"] = {name: term.item() for name, term in result.terms.items()}
        return info

    def _tip(self) -> Array:
        return self.simulation.tip(0)


def action_space(robot: Robot) -> spaces.Space[Float32]:
    """One number in [-1, 1] per joint."""
    return spaces.Box(-1.0, 1.0, (len(robot.joints),), dtype=np.float32)


def _item(values: npt.NDArray[Any]) -> Any:
    return values[0] if values.dtype == object else values.item()
