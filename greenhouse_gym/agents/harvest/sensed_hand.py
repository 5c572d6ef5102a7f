"""Tool and fruit as an arm senses them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.harvest.fruit_map import FruitMap
from greenhouse_gym.agents.harvest.picking import Twist, joint_change
from greenhouse_gym.agents.harvest.seen_surface import SeenSurface
from greenhouse_gym.agents.occupancy_map import wrist_camera
from greenhouse_gym.envs.features import feature_slices
from greenhouse_gym.envs.image_observations import RgbObservation
from greenhouse_gym.envs.tasks.harvest import TomatoHarvest
from greenhouse_gym.geometry import Array, distance_to_nearest, rotation_about
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.motion.unknown_space import guarded
from greenhouse_gym.rendering.cameras import MAX_RANGE, DepthCamera
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.scene.mjcf import base_position

_EXPLAINED = 0.012  # metres from a shape of the scan
_EVERY = 2  # actions from one image to the next that is read
_LOOSE, _ACTIONS = 0.5, 2  # a fruit is off that pulls with less than this fraction of its weight for so many actions
_PULL = 0.4  # N: pull of a fruit that is not off at least
_ANOTHER = 0.01  # metres by which another fruit is nearer to the cup
_TURNED = 13  # actions of turning after which a fruit whose weight is borne is off


class SensedHand:
    """Tool and fruit by the readings of the arm; a `greenhouse_gym.agents.harvest.picking.Hand`.

    Args:
        problem: The episode.
        image: Width and height of the camera's images, pixels.

    Attributes:
        chain: Kinematic chain of the tool in the scene.
        turn: (3, 3) scene_from_base.
        fruit: The fruit.
        surface: Points that the camera sees and the scan lacks, in the frame of the base.
        working: The fruit in work.
        parting: Whether it is being turned off.
        joints: (j,) measured joint positions, radians.
        command: (j,) commanded ones.
        holds: Whether the cup holds a fruit.
        crate: (3,) middle of the crate's rim in the scene, metres.
        deflection: Metres by which something keeps the tip from where its servos pull it.
        resisted: Radians by which something keeps a joint from where its servo pulls it.
    """

    def __init__(self, problem: Problem, image: tuple[int, int]):
        self._problem, self.interval = problem, problem.interval
        compiled = guarded(problem.scene, problem.robot, problem.start, np.inf)
        self.chain = tool_chain(compiled.model, compiled.tip_site)
        self.fruit = FruitMap(problem.scene)
        self.working = -1
        self._camera = DepthCamera("wrist", *image)
        spec = RgbObservation(self._camera, depth=True)(problem.robot, TomatoHarvest())
        self._features = feature_slices(spec.layout)
        self.turn = rotation_about([0, 0, 1], problem.scene.placement.yaw)
        self.base = base_position(problem.scene, problem.robot)
        self.surface = SeenSurface(arm_spheres(problem.robot), self._camera, self._in_scan)
        self._age, self._loose, self._confirmations = 0, 0, _ACTIONS
        self.parting = False

    def _in_scan(self, points: Array) -> npt.NDArray[np.bool_]:
        """Return which points (n, 3), in the frame of the base, the scan shows."""
        near = distance_to_nearest(points @ self.turn.T + self.base, self._problem.scene.arrays, _EXPLAINED)
        return np.asarray(near < _EXPLAINED)

    def sense(self, observation: Mapping[str, Any]) -> None:
        """Take over an observation."""
        state = observation["state"].astype(np.float64)

        def value(name: str) -> Array:
            return np.asarray(state[self._features[name]])

        robot = self._problem.robot
        self.joints = value("joint_position")
        self.command = np.clip(self.joints + value("command_error"), robot.lower, robot.upper)
        self._state = tool_state(self.chain, self.joints[None])
        # a servo in motion lags; what is left of its error is what something presses against
        pressed = value("command_error") - robot.lag * value("joint_velocity")
        self.deflection = float(self.tip[1] @ self._state.jacobian[0] @ pressed)
        self.resisted = float(np.abs(pressed).max())
        self.holds = value("gripper")[0] > 0
        self._force = self.turn @ value("wrist_force")
        self.crate = self.tip[0] + self.turn @ value("crate_offset")
        if self._age % _EVERY == 0:
            turn, origin = (poses[0] for poses in wrist_camera(self.chain, self.joints[None]))
            depth = (observation["depth"][0] * MAX_RANGE).reshape(-1).astype(np.float64)
            rays = self._camera.rays @ turn.T
            points = origin + depth[:, None] * rays
            held = (self.working, self.center(self.working)) if self.holds else None
            self.fruit.see(rays, origin, depth, observation["rgb"].reshape(3, -1).T, held)
            view = self.turn.T @ turn, self.turn.T @ (origin - self.base)
            self.surface.see(depth, (points - self.base) @ self.turn, view, self.joints)
        self._age += 1
        if self.parting and self.holds:
            loose = np.linalg.norm(self.force) < _LOOSE * self._weight
            self._loose = self._loose + 1 if loose else 0
            if self._loose >= self._confirmations:
                self.fruit.pick(self.working)

    def begin(self, fruit: int) -> None:
        """Begin to turn off the fruit at the cup, which may be another one than was to be picked."""
        tip, axis = self.tip
        at_cup = tip + self.fruit.radii[:, None] * axis
        apart = np.where(self.fruit.hanging, np.linalg.norm(self.fruit.centers - at_cup, axis=1), np.inf)
        self.working = int(apart.argmin()) if apart.min() < apart[fruit] - _ANOTHER else fruit
        self.parting, self._loose, self._confirmations = True, 0, _ACTIONS

    def bear(self) -> None:
        """Let the cup bear the weight of its fruit, which is felt to be off after some actions of turning only."""
        self.fruit.relieve(self.working)
        self._confirmations = _TURNED

    @property
    def held(self) -> int:
        """Fruit in the cup, or -1."""
        return self.working if self.holds else -1

    @property
    def tip(self) -> tuple[Array, Array]:
        """Position (3,) and direction (3,) of the tool in the scene."""
        return self._state.point[0], self._state.axis[0]

    @property
    def force(self) -> Array:
        """(3,) force of the held fruit on the cup beyond its weight, N, in the scene."""
        return np.asarray(self._force + [0.0, 0.0, self._weight if self.holds else 0.0])

    @property
    def pulls(self) -> bool:
        """Return whether the held fruit pulls sideways at rest, as one on its truss does far from where it hangs.

        How it pulls up or down says less, since its weight is known by the scan's radius alone.
        """
        return bool(np.linalg.norm(self.force[:2]) > max(_LOOSE * self._weight, _PULL))

    def weigh(self) -> None:
        """Weigh the held fruit, which is off and at rest."""
        self.fruit.weigh(self.working, float(-self._force[2]))

    @property
    def _weight(self) -> float:
        """Weight of the fruit in work, N."""
        return float(self.fruit.weights[self.working])

    def center(self, fruit: int) -> Array:
        """Return the middle (3,) of a fruit; a held one is at the cup."""
        if self.holds and fruit == self.working:
            tip, axis = self.tip
            return np.asarray(tip + self.radius(fruit) * axis)
        return np.asarray(self.fruit.centers[fruit])

    def radius(self, fruit: int) -> float:
        """Return the radius of a fruit, metres."""
        return float(self.fruit.radii[fruit])

    def joint(self, fruit: int) -> Array:
        """Return the presumed start (3,) of a fruit's pedicel."""
        return self.fruit.joint(fruit)

    def hanging(self) -> list[int]:
        """Return the fruit that hang."""
        hanging: list[int] = np.flatnonzero(self.fruit.hanging).tolist()
        return hanging

    def towards(self, twist: Twist) -> Array:
        """Return the change (j,) of the commands for a motion of the tip."""
        jacobian = np.concatenate([self._state.jacobian[0], self._state.joint_axes[0]])
        return joint_change(jacobian, twist, self.interval, self._problem.joint_steps)
