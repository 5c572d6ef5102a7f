"""A simulated rig walks along a grown row: the same `Recording` a real rig gives, with true poses."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.frames import RgbdFrame, Station
from greenhouse_gym.capture.light import Light, draw_light
from greenhouse_gym.capture.raycast import RowRaycaster, View
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import SEED_RIG, Camera, Rig
from greenhouse_gym.capture.sensor import StereoDoubt, StereoNoise, doubtful, draw_biases, mix_edges, sense_depth
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, pose, rotation_about


@dataclass(frozen=True)
class WalkSettings:
    """How the tripod is moved by hand; errors are uniform."""

    step: float = 0.10  # m between stations
    step_error: float = 0.015  # m, each step, accumulating
    offset_error: float = 0.01  # m, sideways and in height, around the nominal line
    back: float = 0.0  # m by which the nominal line lies behind the row's x = 0
    angle_error: float = float(np.deg2rad(2.0))  # rad about each axis, around the nominal attitude
    camera_offset: float = 0.0  # m, along each axis, by which the cameras stand off the places the rig gives
    camera_angle: float = 0.0  # rad about each axis that they are turned by; the reference camera is not
    color_noise: float = 2.5  # gray levels, one sigma
    noise: StereoNoise = field(default_factory=StereoNoise)
    doubt: StereoDoubt = field(default_factory=StereoDoubt)  # what stereo loses besides, on rows of organs


def simulate_recording(
    row: PlantRow,
    seed: int,
    rig: Rig = SEED_RIG,
    stations: int | None = None,
    settings: WalkSettings | None = None,
    walk_number: int = 0,
    light: Light | None = None,
) -> Recording:
    """Photograph a grown row with a simulated rig.

    Stations are rendered when they are asked for; the same station comes out the same every time.

    Args:
        row: The row.
        seed: Seed of the walk, the camera biases and the noise.
        rig: The cameras.
        stations: Number of stops; by default one every step over the row's length.
        settings: Tripod and sensor errors.
        walk_number: Tells walks of the same cameras along the same row apart: other steps and noise, the same biases.
        light: What falls on a row of organs; by default drawn from the seed. Rows of primitives have their own.

    Returns:
        A recording whose stations carry their true poses, in the row's frame, and which knows the row as its truth.

    Raises:
        InvalidValueError: ``stations`` is not positive, or ``seed`` is negative.
    """
    settings = settings or WalkSettings()
    count = round(row.length / settings.step) if stations is None else stations
    if count < 1:
        raise InvalidValueError(f"stations must be at least 1, got {count}")
    if seed < 0:
        raise InvalidValueError(f"seed must be 0 or more, got {seed!r}")
    return photograph(row, seed, rig, walk(count, seed, rig, settings, walk_number), settings, walk_number, light)


def photograph(
    row: PlantRow,
    seed: int,
    rig: Rig,
    poses: Array,
    settings: WalkSettings | None = None,
    walk_number: int = 0,
    light: Light | None = None,
) -> Recording:
    """Photograph a grown row from given places; otherwise as `simulate_recording`.

    Args:
        row: The row.
        seed: Seed of the camera biases and the noise.
        rig: The cameras.
        poses: (stations, 4, 4) where the rig stands in the row's frame.
        settings: Sensor errors.
        walk_number: As in `simulate_recording`.
        light: As in `simulate_recording`.
    """
    settings = settings or WalkSettings()
    light = light or draw_light(np.random.default_rng([seed, 4]))
    load = _Photographs(row, seed, rig, poses, settings, walk_number, light)
    return Recording(f"simulated-{seed}", rig, len(poses), load, truth=row)


@dataclass(frozen=True, eq=False)
class _Photographs:
    """Gives the stations of a simulated recording; the fields are as in `photograph`."""

    row: PlantRow
    seed: int
    rig: Rig
    poses: Array
    settings: WalkSettings
    walk_number: int
    light: Light

    @cached_property
    def _caster(self) -> RowRaycaster:
        return RowRaycaster.of(self.row, self.light)

    def __reduce__(self) -> tuple[Any, ...]:
        return _Photographs, tuple(getattr(self, one.name) for one in fields(self))  # without Open3D's scene

    def __call__(self, i: int) -> Station:
        seed, again = self.seed, (self.walk_number,) if self.walk_number else ()
        biases = draw_biases(len(self.rig.cameras), np.random.default_rng([seed, 1]), self.settings.noise)
        frames = {}
        for k, (name, camera) in enumerate(misplaced(self.rig, seed, self.settings).cameras.items()):
            rng = np.random.default_rng([seed, 2, i, k, *again])
            own = np.random.default_rng([seed, 5, i, k, *again])
            at = replace(self._caster, light=self.light.at_station(own))
            view = at.look(self.poses[i] @ camera.rig_from_camera, camera.intrinsics)
            depth = _sensed(view, camera.intrinsics.fx, rng, own, self.settings, float(biases[k]))
            noise = self.settings.color_noise * rng.standard_normal(view.color.shape, dtype=np.float32)
            color = np.clip(view.color + noise, 0, 255).astype(np.uint8)
            frames[name] = RgbdFrame(color, depth, camera.intrinsics)
        return Station(frames, self.poses[i])


def _sensed(
    view: View, fx: float, rng: np.random.Generator, own: np.random.Generator, settings: WalkSettings, bias: float
) -> npt.NDArray[np.float32]:
    """The depth a camera reports of what it sees; ``own`` is the source of what it loses on organs."""
    if view.glare is None:
        return sense_depth(view.depth, fx, rng, settings.noise, bias)
    true = mix_edges(view.depth, own, settings.doubt.mixed)
    lost = doubtful(view.depth, view.color, view.glare, fx, settings.doubt, settings.noise.baseline)
    return sense_depth(true, fx, rng, settings.noise, bias, lost)


def misplaced(rig: Rig, seed: int, settings: WalkSettings) -> Rig:
    """The cameras where they really stand, of a rig whose file is not quite right."""
    rng = np.random.default_rng([seed, 3])
    cameras = {}
    for name, camera in rig.cameras.items():
        shift = rng.uniform(-settings.camera_offset, settings.camera_offset, 3)
        angles = rng.uniform(-settings.camera_angle, settings.camera_angle, 3)
        there = camera.rig_from_camera
        if name != rig.reference:
            turn = Rotation.from_rotvec(angles).as_matrix()
            there = pose(turn @ there[:3, :3], there[:3, 3] + shift)
        cameras[name] = Camera(camera.intrinsics, there, camera.depth_scale)
    return Rig(cameras, rig.reference)


def walk(count: int, seed: int, rig: Rig, settings: WalkSettings, number: int = 0) -> Array:
    """Poses of the rig at each station, (count, 4, 4) world_from_station.

    Angles turn about the reference camera, where a tripod's head is, so they do not add to the offsets.
    """
    rng = np.random.default_rng([seed, 0, number] if number else [seed, 0])
    steps = settings.step + rng.uniform(-settings.step_error, settings.step_error, count)
    along = np.concatenate([[0.0], np.cumsum(steps[1:])])
    offsets = rng.uniform(-settings.offset_error, settings.offset_error, (count, 2))
    angles = rng.uniform(-settings.angle_error, settings.angle_error, (count, 3))
    head = rig.cameras[rig.reference].rig_from_camera[:3, 3]
    poses = np.empty((count, 4, 4))
    for i in range(count):
        turn = np.eye(3)
        for axis, angle in zip(np.eye(3), angles[i], strict=True):
            turn = turn @ rotation_about(axis, float(angle))
        shift = np.array([offsets[i, 0] - settings.back, along[i], offsets[i, 1]])
        poses[i] = pose(turn, head + shift - turn @ head)
    return poses
