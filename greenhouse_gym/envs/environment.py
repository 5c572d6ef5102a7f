"""Gymnasium environment of a single simulation."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.contacts import CONTACT_GROUPS
from greenhouse_gym.envs.episodes import DifficultyChoice
from greenhouse_gym.envs.hindsight import add_goal_functions
from greenhouse_gym.envs.infos import numbers_only
from greenhouse_gym.envs.observations import Observed, select
from greenhouse_gym.envs.rewards import StepResult
from greenhouse_gym.envs.settings import EnvSettings, settings_with
from greenhouse_gym.envs.simulation import Simulation
from greenhouse_gym.envs.specification import EnvMixin
from greenhouse_gym.errors import EpisodeOverError, require_choice, require_seed
from greenhouse_gym.geometry import Array
from greenhouse_gym.rendering.renderer import Viewpoint
from greenhouse_gym.rendering.viewer import RENDER_MODES, Picture, Viewer, available_modes
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene

_ONLY = np.array([0])


class GreenhouseEnv(EnvMixin, gymnasium.Env[Observed, npt.NDArray[np.float32]]):  # type: ignore[misc]
    """Environment of an arm in front of tomato plants with a task, see ``task``.

    ``TomatoReach-v0`` has the task `TomatoReach`, and ``TomatoLook-v0`` `TomatoLook`.

    An episode takes place in one scene of a bank, with one or several of its tomatoes as targets. The arm carries a
    slender suction gripper; its *tip* is the center of the cup, and the *grasp point* lies one target radius ahead of
    the tip along the tool. Below, j is the number of the arm's joints and k the number of its probe points (``ur5e``: 6
    and 9, ``iiwa14``: 7 and 9).

    **Frame.** Positions are in the frame of the arm's stand at the height of its base: x forward to the plants, y left
    along the row, z up. ``info`` and `render` use it as well.

    **Time.** 20 actions per second (``rate``), each with 5 physics steps of 10 ms in which the servos follow a ramp to
    the new commands. The environment itself truncates an episode after 200 steps (``step_limit``), without a
    `TimeLimit` wrapper. ``max_episode_steps`` of ``gymnasium.make`` adds one, which can only shorten episodes.

    **Action** ``Box(-1, 1, (size,), float32)``. Values outside [-1, 1] are clipped. An action that is not finite or has
    another shape raises an error and changes nothing.

    | ``action`` | size | an entry of 1 means |
    |---|---|---|
    | ``tip_velocity``, the default | 6 | the tip moves at 0.5 m/s along x, y, z, then rotates at 1.6 rad/s about them |
    | ``joint`` | j | the joint's command moves by 0.08 rad |
    | ``joint_velocity`` | j | the joint's command moves at its speed limit |

    Damped least squares convert tip velocities to joint velocities. Whatever the action, commands obey the joints'
    position limits (``info["position_limited"]`` counts stops) and speed limits (the whole motion is then scaled down,
    ``info["speed_limited"]`` counts it), and stay within 0.2 rad of the measured joints.

    **Observation** ``state``, ``Box((72,), float32)`` for ``ur5e``, 3 j + 18 + 4 k entries in general:

    | ``ur5e`` | ``iiwa14`` | feature | meaning | bounds | unit |
    |---|---|---|---|---|---|
    | 0 to 5 | 0 to 6 | ``joint_position`` | joint positions | joint limits widened by 0.1 | rad |
    | 6 to 11 | 7 to 13 | ``joint_velocity`` | joint velocities | twice the speed limits | rad/s |
    | 12 to 17 | 14 to 20 | ``command_error`` | command minus joint position | +-0.4 | rad |
    | 18 to 20 | 21 to 23 | ``tip_position`` | the tip | +-3 | m |
    | 21 to 23 | 24 to 26 | ``tool_axis`` | unit vector along the tool | +-1 | |
    | 24 to 26 | 27 to 29 | ``grasp_offset`` | from the grasp point to the target's center | +-3 | m |
    | 27 to 29 | 30 to 32 | ``target_position`` | the target's center | +-3 | m |
    | 30 to 32 | 33 to 35 | ``target_direction`` | unit vector from the tip to the target's center | +-1 | |
    | 33 to 35 | 36 to 38 | ``turn_to_target`` | cross product of tool axis and that direction | +-1 | |
    | 36 to 44 | 39 to 47 | ``clearance`` | of the arm's surface at the probe points, arm to tip | -0.1 to 0.3 | m |
    | 45 to 71 | 48 to 74 | ``obstacle_direction`` | unit vectors from there to the nearest obstacle | +-1 | |

    Features from ``grasp_offset`` to ``turn_to_target`` are those of the task; another task may have others. Vectors
    are x y z; those to obstacles are 0 beyond 0.3 m. Obstacles are stems, clutter and all tomatoes except the target,
    but not the floor, the cart or the arm itself. The turn is the axis that turns the tool to the target, as long as
    the sine of the angle. Distances come from a field with nodes 2 cm apart (error within 5 cm of an obstacle: mean 1
    mm, 95 % within 4 mm, at most 12 mm). Values beyond a bound are clipped to it. The other observations:

    | ``observation`` | key | shape, type | meaning |
    |---|---|---|---|
    | ``state_occupancy`` | (a vector) | (3 j + 18 + 5 k,) float32 | ``state``, then 1 per probe in unknown space |
    | ``roadmap`` | (a vector) | (5 j + 8 + 4 k,) float32 | part of ``state``, then waypoint and path, rad |
    | ``task`` | ``state`` | (3 j + 18,) float32 | ``state`` without its last two features |
    | | names of the task | | arrays that the task remembers, such as ``map`` of `TomatoLook` |
    | ``goal`` | ``achieved_goal`` | (3,) float64 | grasp point, m |
    | | ``desired_goal`` | (3,) float64 | the target's center, m |
    | | ``observation`` | (3 j + 6 + 4 k,) float32 | ``state`` without the features of the task, but see below |
    | ``goal_roadmap`` | ``observation`` | (5 j + 8 + 4 k,) float32 | as in ``goal``, then as in ``roadmap`` |
    | | ``achieved_goal``, ``desired_goal`` | | as in ``goal`` |
    | ``depth`` | ``depth`` | (1, 48, 64) float32 | depth over 2 m, 0 to 1; 0 without a reading |
    | | ``state`` | (3 j + 18,) float32 | ``state`` without its last two features |
    | ``points`` | ``points`` | (768, 3) float32 | points in 24 rows of 32, m; 0 0 0 without a reading |
    | | ``state`` | (3 j + 18,) float32 | as in ``depth`` |
    | ``rgb`` | ``rgb`` | (3, 48, 64) uint8 | color image of the camera of ``depth``, without shadows |
    | | ``state`` | (3 j + 18,) float32 | as in ``depth`` |
    | ``rgbd`` | ``depth``, ``rgb``, ``state`` | | as above |

    - ``goal``: clearances include the target, so that the vector does not depend on it.
    - ``roadmap``: ``state`` without tip, tool axis, direction and turn. The waypoint is a goal configuration that a
      collision-free straight motion in the known scene reaches, or else the node with the shortest path in a tree that
      grows from the goal configurations. The vector holds its offset from the commanded joints and the action that
      moves there at full speed, j numbers each, then the length of the path from there to the goal (rad), and 1 if the
      straight motion is collision-free. Where no such waypoint is known, that is 0 and an arbitrary goal takes its
      place. A waypoint is more than a sensor could provide: it is a plan of a few straight motions in the known scene,
      and finding it takes time at the start of an episode. It is updated every 8 steps and on arrival
      (`greenhouse_gym.envs.waypoints`).
    - ``depth``, ``rgb`` and ``rgbd`` come from a camera next to the flange that looks along the tool; ``points`` is the
      view of the plants from a mast next to the arm, one point per pixel. `DepthObservation`, `PointsObservation` and
      `RgbObservation` in place of the name choose the camera ("wrist" or "mast"), its size and its field of view.

    **Your own.** ``observation``, ``action``, ``reward`` and ``task`` also take your own objects: see `Observation`,
    `ActionRule`, `Transition` and `Task`, and the folder ``examples``. They compute arrays of n simulations; the single
    environment has one. Their results are checked at every step.

    **Goals.** With ``observation="goal"`` or ``"goal_roadmap"``, the methods ``compute_reward``,
    ``compute_terminated`` and ``compute_truncated`` (``achieved_goal``, ``desired_goal``, ``info``) evaluate one or n
    steps with other goals; they read everything else from the info (hindsight replay of Stable-Baselines3 needs
    ``copy_info_dict=True``).

    **Contacts.** Contacts of the arm are counted by group after every physics step, until one ends the episode: fruit,
    stem, leaf, fixture (floor, cart, pipes, strings, gutters) and self. The task decides which groups end the episode;
    by default all do. The cup may touch the targets, which is not counted.

    **Leaves that give way.** With ``plants="brush"``, leaves exert no force: the arm moves exactly as it would without
    them, contacts with them end no episode, and each second in which one is touched costs 0.4 (`Task.brush_cost`, the
    reward term ``brush``). Clearances, rays and the directions to obstacles ignore leaves; images still show them, and
    paths of ``roadmap`` lead through leaves only where no path leads around them. Leaves are leaf blades, petioles,
    calyces and flowers in the true row, and all boxes but gutters in a reconstruction, see
    `greenhouse_gym.crops.parts.is_leaf`; a leaf counts as several, because it consists of several shapes.

    **Info**, on reset and step:

    | key | meaning |
    |---|---|
    | ``is_success`` | bool (flags and numbers are NumPy's scalars) |
    | ``collision`` | whether a contact ended the episode |
    | ``contact`` | names of the two geoms of the first such contact, as "rod, stem_3"; empty without a collision |
    | ``self_collision`` | whether both belong to the arm |
    | ``contacts`` | number of contacts by group, summed over the physics steps of the action |
    | ``distance`` | remaining distance; from the grasp point to the target's center, m |
    | ``clearance`` | the smallest of the observed ones, before clipping, m |
    | ``scene``, ``target``, ``difficulty`` | name, index of the tomato, rating ("unrated" if not rated for this arm) |
    | ``steps`` | steps of this episode |
    | ``speed_limited`` | steps of this episode that were scaled down to the speed limits |
    | ``position_limited`` | number of times that a joint's command stopped at its limit in this episode |
    | ``brushing`` | with ``plants="brush"``: time in the last action in which a leaf was touched, s |
    | ``brushed_time`` | likewise: that time in the episode, s |
    | ``brushed_leaves`` | likewise: different shapes of leaves touched at the ends of actions of the episode |
    | ``reward_terms`` | on step only: the terms by name |
    | ``previous_goal``, ``effort`` | on step of ``goal``: achieved goal before it, sum of the action's squares |

    Numbers that the task remembers (`Task.memory`) follow under their own names. A task may add entries to the action
    (`Task.controls`).

    **Reset options**

    | option | meaning |
    |---|---|
    | ``scene`` | name of a scene of any split, or a `Scene` |
    | ``target`` | index of any of its tomatoes; needs ``scene``, here or among the settings |
    | ``start`` | joint angles, rad, or a name such as ``upright`` or ``folded``; one in contact collides at once |
    | ``difficulty`` | for this episode, instead of the environment's |

    **Versions.** A ``-v1`` is due for any change of what an agent observes or is rewarded for: spaces, order or meaning
    of entries, scale or rate of actions, physics, success, collision, reward, or the episodes that a seed draws. New
    choices, new info keys, speed and another bank (which has its own name) are no reason.

    Args:
        settings: The settings; default `EnvSettings` if None.
        render_mode: "rgb_array" (by OpenGL, or by ray casting where it is missing), "depth_array" (m), "human" (a
            window) or None. The straight line from tip to target is red, the tip's path pink.
        width: Width of the images, pixels.
        height: Height of the images, pixels.
        camera: "aisle", "behind", "side" or "top", or a `greenhouse_gym.rendering.renderer.Viewpoint` in the scene.
        **fields: Fields of `EnvSettings`, which documents them. They replace those of ``settings``.

    Raises:
        UnknownNameError: A name does not exist; the message lists the choices.
        UnknownKeywordError: A keyword does not exist; the message lists the keywords.
        InvalidValueError: A setting is invalid, or the goals of a goal environment would differ from the true ones.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        settings: EnvSettings | None = None,
        *,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        camera: str | Viewpoint = "aisle",
        **fields: Any,
    ):
        self.settings = settings_with("GreenhouseEnv", settings, fields)
        self.options = {"render_mode": render_mode}
        if render_mode is not None:
            self.options |= {"width": width, "height": height, "camera": camera}
        self.render_mode = None if render_mode is None else require_choice("render mode", render_mode, RENDER_MODES)
        picture = Picture(width, height, camera)
        self._viewer = None if render_mode is None else Viewer(render_mode, picture)
        self.metadata = {"render_modes": available_modes(), "render_fps": self.settings.rate}
        self.simulation = Simulation(1, self.settings, threads=1)
        self.observation_space = self.simulation.observe.space
        self.action_space: spaces.Box = self.simulation.action_space  # type: ignore[assignment]
        add_goal_functions(self)
        self._tip_trace: list[Array] = []
        self._over = False

    @property
    def robot(self) -> Robot:
        """Arm of the environment."""
        return self.simulation.robot

    @property
    def scene(self) -> Scene:
        """The scene of the current episode."""
        return self.simulation.episode(0).scene

    @property
    def target(self) -> int:
        """Index of the current target among the tomatoes of `scene`."""
        return self.simulation.target(0)

    @property
    def start(self) -> Array:
        """(joints,) start configuration of the current episode, radians."""
        return self.simulation.episode(0).start

    def set_difficulty(self, difficulty: DifficultyChoice) -> None:
        """Set the difficulties of targets from the next reset on, see `EnvSettings.difficulty`."""
        self.simulation.sampler.set_difficulty(difficulty)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Begin an episode; see the class for the options."""
        seed = None if seed is None else require_seed(seed)
        super().reset(seed=seed)
        if seed is not None:
            self.simulation.sampler.restart(seed)
        self.simulation.reset(_ONLY, [self.np_random], [options])
        self._over = False
        self._tip_trace = [self._tip()] if self._viewer else []
        self._show()
        return self._observation(), self._info(None)

    def step(self, action: Any) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Apply an action.

        Raises:
            InvalidValueError: The action has the wrong shape or is not finite.
            EpisodeOverError: The episode has ended.
        """
        if self._over:
            raise EpisodeOverError("the episode has ended: call reset() before the next step")
        result = self.simulation.step(np.asarray(action)[None])
        terminated, truncated = result.terminated.item(), result.truncated.item()
        self._over = terminated or truncated
        if self._viewer:
            self._tip_trace.append(self._tip())
            self._show()
        return self._observation(), result.reward.item(), terminated, truncated, self._info(result)

    def render(self) -> npt.NDArray[Any] | None:  # type: ignore[override]
        """Return an image of the arm and the plants: (h, w, 3) uint8 or (h, w) float32 metres; None in mode "human"."""
        if self._viewer is None:
            return None
        model, data = self.model_and_data()
        goal = self.simulation.goal(0)
        return self._viewer.draw(model, data, self.scene.placement, self._tip(), goal, self._tip_trace)

    def close(self) -> None:
        """Free the simulation and the window; a later reset creates new ones."""
        self.simulation.close()
        if self._viewer:
            self._viewer.close()

    def model_and_data(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return a copy of the episode's MuJoCo model and its current state.

        The servos follow ``data.act``, the commanded positions (rad), which move with the speeds ``data.ctrl`` (rad/s).
        """
        return self.simulation.model_and_data(0)

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()

    def _observation(self) -> Observed:
        return select(self.simulation.observation(), 0)

    def _info(self, result: StepResult | None) -> dict[str, Any]:
        values = self.simulation.info(result)
        contacts = dict(zip(CONTACT_GROUPS, values.pop("contacts")[0], strict=True))
        info = {key: _item(array) for key, array in values.items()} | {"contacts": contacts}
        if result is not None:
            info["reward_terms"] = {name: term[0] for name, term in result.terms.items()}
        return numbers_only(info) if self.settings.infos == "numbers" else info

    def _tip(self) -> Array:
        return self.simulation.tip(0)


def _item(values: npt.NDArray[Any]) -> Any:
    """Return the first value, a NumPy scalar if it is a number: libraries read its ``dtype``."""
    return values[0].copy() if values.ndim > 1 else values[0]
