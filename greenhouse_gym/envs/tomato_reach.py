"""The single environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.episodes import DifficultyChoice
from greenhouse_gym.envs.hindsight import goal_functions
from greenhouse_gym.envs.observations import Observed, select
from greenhouse_gym.envs.settings import EnvSettings, settings_with
from greenhouse_gym.envs.simulation import ReachSimulation, StepResult
from greenhouse_gym.envs.spec import SpecMixin
from greenhouse_gym.errors import EpisodeOverError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.rendering.viewer import RENDER_MODES, Viewer
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene

_ONLY = np.array([0])


class TomatoReachEnv(SpecMixin, gymnasium.Env[Observed, npt.NDArray[np.float32]]):  # type: ignore[misc]
    """Reach a tomato with the tool of an arm, and touch nothing else.

    An episode takes place in one scene of a bank, with one of its tomatoes as the target. The arm carries a slender
    suction gripper; its *tip* is the middle of the cup, and the *grasp point* lies one target radius ahead of the tip
    along the tool. j is the number of the arm's joints, k that of its probe points (``ur5e``: 6 and 9, ``iiwa14``: 7
    and 9).

    **Frame.** Positions are in the frame of the arm's stand at the height of its base: x forward to the plants, y left
    along the row, z up. ``info`` and `render` use it, too.

    **Time.** 20 actions per second (``rate``); each is 5 physics steps of 10 ms, in which the servos follow a ramp to
    the new commands. After 200 steps (``step_limit``) an episode is truncated by the environment itself: there is no
    `TimeLimit` wrapper. ``max_episode_steps`` of ``gymnasium.make`` puts one around it, which can only cut shorter.

    **Action** ``Box(-1, 1, (size,), float32)``. Values beyond [-1, 1] are clipped; anything that is not finite, or of
    another shape, is an error and changes nothing.

    | ``action`` | size | an entry of 1 means |
    |---|---|---|
    | ``joint`` | j | the joint's command moves by 0.08 rad |
    | ``joint_velocity`` | j | the joint's command moves at its speed limit |
    | ``tip_velocity`` | 6 | the tip moves at 0.5 m/s along x, y, z, then turns at 1.6 rad/s about them |

    Tip velocities become joint velocities by damped least squares. Whatever the action, commands keep to the
    joints' limits (``info["position_limited"]`` counts where they stopped), to their speed limits (the whole motion is
    slowed then, ``info["speed_limited"]`` counts it), and within 0.2 rad of the measured joints. Contacts of the
    arm with itself are collisions (``info["self_collision"]``).

    **Observation** ``state``, ``Box((60,), float32)`` for ``ur5e``, 3 j + 6 + 4 k entries in general:

    | ``ur5e`` | ``iiwa14`` | meaning | bounds | unit |
    |---|---|---|---|---|
    | 0 to 5 | 0 to 6 | joint positions | joint limits widened by 0.1 | rad |
    | 6 to 11 | 7 to 13 | joint velocities | twice the speed limits | rad/s |
    | 12 to 17 | 14 to 20 | command minus joint position | +-0.4 | rad |
    | 18 to 20 | 21 to 23 | from the grasp point to the target's center | +-3 | m |
    | 21 to 23 | 24 to 26 | the target's center | +-3 | m |
    | 24 to 32 | 27 to 35 | clearance of the arm's surface at the probe points, arm to tip | -0.1 to 0.3 | m |
    | 33 to 59 | 36 to 62 | unit vectors from there to the nearest obstacle, x y z each; 0 beyond 0.3 m | +-1 | |

    Obstacles here are stems, clutter and all tomatoes but the target, not the floor, the cart or the arm itself.
    They are read from a distance field with nodes 2 cm apart (error within 5 cm of an obstacle: mean 1 mm, 95 % within
    4 mm, at most 12 mm). Values beyond a bound are clipped to it. ``state_occupancy`` appends one
    number for each probe point: 1 in space that the scan did not observe, else 0. The other kinds are `Dict` spaces:

    | ``observation`` | key | shape, type | meaning |
    |---|---|---|---|
    | ``clearance_rays`` | (a vector) | (3 j + 6 + 4 k + 48,) float32 | ``state``, then clearances on rays, m |
    | ``waypoint`` | (a vector) | (5 j + 8 + 4 k,) float32 | as ``state``, then where the arm can go straight, rad |
    | ``goal`` | ``achieved_goal`` | (3,) float64 | grasp point, m |
    | | ``desired_goal`` | (3,) float64 | the target's center, m |
    | | ``observation`` | (3 j + 6 + 4 k,) float32 | as ``state``, but see below |
    | ``goal_waypoint`` | ``observation`` | (5 j + 8 + 4 k,) float32 | as in ``goal``, then as in ``waypoint`` |
    | | ``achieved_goal``, ``desired_goal`` | | as in ``goal`` |
    | ``depth`` | ``depth`` | (1, 48, 64) float32 | depth over 2 m, 0 to 1; 0 without a reading |
    | | ``state`` | (3 j + 6,) float32 | the first entries of ``state``, up to the target's center |
    | ``points`` | ``points`` | (768, 3) float32 | points in 24 rows of 32, m; 0 0 0 without a reading |
    | | ``state`` | (3 j + 6,) float32 | as in ``depth`` |
    | ``rgb`` | ``rgb`` | (3, 48, 64) uint8 | what the camera of ``depth`` sees, without shadows |
    | | ``state`` | (3 j + 6,) float32 | as in ``depth`` |
    | ``rgbd`` | ``depth``, ``rgb``, ``state`` | | as above |

    In ``goal``, tip position (m) and tool axis (unit vector) replace offset and target, and the clearances count the
    target as an obstacle, so that nothing in it depends on the target. The room around the target is the distance to
    obstacles on 24 rays from its center towards the arm's side (azimuths by `AZIMUTHS`, within each elevations by
    `ELEVATIONS`), for each ray the smallest at 5 to 13 cm, where the tool would be, and at 18 to 30 cm, of the wrist.
    The waypoint is a goal configuration to which the straight motion is free in the scene as it is known, or else a
    node of a tree that grows from the goals: the nearest by the way over it. It is told as the offset from the
    commanded joints and as the action that goes there at full speed, j numbers each; then follow the way from there to
    the goal, rad, and 1 where the straight motion is free, or 0 where no such waypoint is known and an arbitrary goal
    stands in for it. That is a plan of a few straight motions, made from the known scene: it tells more than a sensor
    could, and finding it takes time at the beginning of an episode. What is left to learn is what to do where there is
    none.
    It is looked for anew every 8 steps and where the arm arrives (`greenhouse_gym.motion.waypoints`).
    ``depth`` comes from a camera beside the flange that looks along the tool; ``points`` is what a camera on a mast
    beside the arm sees of the plants, one per pixel. `DepthObservation`, `PointsObservation` and `RgbObservation` in
    place of the name choose the camera ("wrist" or "mast"), its size and its opening.

    **Your own.** ``observation``, ``action`` and ``reward`` also take objects from outside: see `Observation`,
    `ActionRule` and `Transition`, and the folder ``examples``. They get arrays of n simulations, of which the single
    environment has one. What they give is checked at every step.

    **Goals.** With ``observation="goal"`` or ``"goal_waypoint"``, the methods ``compute_reward``,
    ``compute_terminated`` and ``compute_truncated`` (``achieved_goal``, ``desired_goal``, ``info``) tell what a step
    would have been with another goal, for one step or for n steps; what else counts they read from the info (hindsight
    replay of Stable-Baselines3 needs ``copy_info_dict=True``).

    **Success.** The grasp point is within 2 cm (``success_radius``) of the target's center and nothing was touched in
    any physics step of the action. The cup may touch the target. Any other contact is a **collision**. Both terminate
    the episode.

    **Reward**, the sum of the terms in ``info["reward_terms"]``:

    | term | ``dense`` | ``path`` | ``sparse`` |
    |---|---|---|---|
    | ``success`` | +10 | +10 | +1 |
    | ``collision`` | -1 | -1 | -1 |
    | ``progress`` | 4 per metre the grasp point came nearer | 2 per radian of the path | |
    | ``time`` | -0.02 | -0.02 | |
    | ``effort`` | -0.003 times the sum of the action's squares | as ``dense`` | |

    ``path`` measures progress along the path of ``waypoint`` in joint space: to the waypoint and on to the goal. It
    works with any observation, but not in goal environments.

    **Info**, on reset and step:

    | key | meaning |
    |---|---|
    | ``is_success`` | bool |
    | ``collision`` | bool |
    | ``contact`` | names of the first two geoms that touched, the arm's first; empty without a collision |
    | ``self_collision`` | whether both belong to the arm |
    | ``distance`` | from the grasp point to the target's center, m |
    | ``clearance`` | the smallest of the observed ones, before clipping, m |
    | ``scene``, ``target``, ``difficulty`` | name, index of the tomato, rating ("unrated" where this arm has none) |
    | ``steps`` | steps of this episode |
    | ``speed_limited`` | steps of this episode that were slowed to keep speed limits |
    | ``position_limited`` | how often in this episode a joint's command stopped at its limit |
    | ``reward_terms`` | on step only: the terms by name |
    | ``previous_goal``, ``effort`` | on step of ``goal``: grasp point before it, sum of the action's squares |

    **Reset options**

    | option | meaning |
    |---|---|
    | ``scene`` | name of a scene of any split, or a `Scene` |
    | ``target`` | index of any of its tomatoes, needs ``scene`` |
    | ``start`` | joint angles, rad, or a name such as ``folded``; one that touches something collides at once |
    | ``difficulty`` | for this episode, in place of the environment's |

    **Versions.** A ``-v1`` would be due for a change of anything an agent sees or is paid for: spaces, order or meaning
    of entries, the action's scale or rate, the physics, success, collision, reward, or the episodes that a seed draws.
    New choices beside the old, new info keys and speed are no reason; neither is another bank, which has its own name.

    Args:
        settings: What the environment is made of; the usual `EnvSettings` when left out.
        render_mode: "rgb_array" (by OpenGL, or by ray casting where there is none), "depth_array" (m) or "human" (a
            window); or None. The straight line from tip to target is red, the tip's trace pink.
        **fields: Fields of `EnvSettings`, which documents them: ``bank``, ``split``, ``robot``, ``observation``,
            ``action``, ``reward``, ``difficulty``, ``physics``, ``randomization``, ``capacity``, ``success_radius``,
            ``step_limit``, ``rate`` and ``start``. They take the place of what ``settings`` says.

    Raises:
        UnknownNameError: A name is not among the choices; the message lists them.
        UnknownKeywordError: A keyword does not exist; the message lists those that do.
        InvalidValueError: A setting is not allowed, or a goal environment's goals are not what counts ("truth", wrong
            targets).
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012

    def __init__(self, settings: EnvSettings | None = None, *, render_mode: str | None = None, **fields: Any):
        self.settings = settings_with("TomatoReachEnv", settings, fields)
        self.render_mode = None if render_mode is None else require_choice("render mode", render_mode, RENDER_MODES)
        self._viewer = None if render_mode is None else Viewer(render_mode)
        self.metadata = {**self.metadata, "render_fps": self.settings.rate}
        self.simulation = ReachSimulation(1, self.settings, threads=1)
        self.observation_space = self.simulation.observe.space
        self.action_space: spaces.Box = self.simulation.action_rule.space  # type: ignore[assignment]
        if self.simulation.observe.has_goals:  # only then, since libraries take whoever has them for a goal environment
            functions = goal_functions(self.simulation.reward_terms, self.settings)
            self.compute_reward, self.compute_terminated, self.compute_truncated = functions
        self._tip_trace: list[Array] = []
        self._over = False

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

    def set_difficulty(self, difficulty: DifficultyChoice) -> None:
        """Draw other targets from the next reset on; the class docstring says what may be given."""
        self.simulation.sampler.set_difficulty(difficulty)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Begin an episode; the class docstring lists the options."""
        super().reset(seed=seed)
        if seed is not None:
            self.simulation.sampler.restart(seed)
        self.simulation.reset(_ONLY, [self.np_random], [options])
        self._over = False
        self._tip_trace = [self._tip()] if self._viewer else []
        self._show()
        return self._observation(), self._info(None)

    def step(self, action: Any) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Act once.

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
        """The arm in front of the plants: (h, w, 3) uint8 or (h, w) float32 metres; None in mode "human"."""
        if self._viewer is None:
            return None
        model, data = self.model_and_data()
        goal = self.simulation.goal(0)
        return self._viewer.draw(model, data, self.scene.placement, self._tip(), goal, self._tip_trace)

    def close(self) -> None:
        """Free the simulation and the window; a later reset makes them anew."""
        self.simulation.close()
        if self._viewer:
            self._viewer.close()

    def model_and_data(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """A copy of the episode's MuJoCo model and its current state, to look at or to compute with.

        Its servos follow ``data.act``, the commanded positions (rad), which move with the speeds ``data.ctrl`` (rad/s).
        """
        return self.simulation.model_and_data(0)

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()

    def _observation(self) -> Observed:
        return select(self.simulation.observation(), 0)

    def _info(self, result: StepResult | None) -> dict[str, Any]:
        info = {key: _item(values) for key, values in self.simulation.info(result).items()}
        if result is not None:
            info["reward_terms"] = {name: term.item() for name, term in result.terms.items()}
        return info

    def _tip(self) -> Array:
        return self.simulation.tip(0)


def _item(values: npt.NDArray[Any]) -> Any:
    return values[0].copy() if values.ndim > 1 else values.item()
