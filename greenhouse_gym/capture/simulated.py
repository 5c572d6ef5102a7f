"""Simulated rig that passes along a grown row: the same `Recording` that a real rig gives, with true poses."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.light import Light, draw_light
from greenhouse_gym.capture.raycast import RowRaycaster, View
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import SEED_RIG, RgbdFrame, Rig, Station
from greenhouse_gym.capture.sensor import (
    StereoDropout,
    StereoNoise,
    TimeOfFlightNoise,
    draw_biases,
    dropout_probability,
    mix_edges,
    sense_depth,
    sense_time_of_flight,
)
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.errors import check_whole, require_seed
from greenhouse_gym.geometry import Array, pose, rotation_about


@dataclass(frozen=True)
class CaptureSettings:
    """Errors of a tripod that is moved by hand, and of its cameras; errors are uniform unless a sigma is given."""

    step: float = 0.10  # m between stations
    step_error: float = 0.015  # m, each step, accumulating
    offset_error: float = 0.01  # m, sideways and in height, around the nominal line
    back: float = 0.0  # m of the nominal line behind the row's x = 0
    angle_error: float = float(np.deg2rad(2.0))  # rad about each axis, around the nominal attitude
    camera_offset: float = 0.0  # m, along each axis, of the cameras from where the rig has them
    camera_angle: float = 0.0  # rad about each axis, of all cameras except the reference camera
    color_noise: float = 2.5  # gray levels, one sigma
    noise: StereoNoise | TimeOfFlightNoise = field(default_factory=StereoNoise)
    dropout: StereoDropout = field(default_factory=StereoDropout)  # of stereo, on rows of organ meshes only


def simulate_recording(
    row: PlantRow,
    seed: int,
    rig: Rig = SEED_RIG,
    stations: int | None = None,
    settings: CaptureSettings | None = None,
    pass_number: int = 0,
    light: Light | None = None,
) -> Recording:
    """Photograph a grown row with a simulated rig.

    A station is rendered each time it is accessed, always with the same result.

    Args:
        row: The row.
        seed: Seed of the tripod's motion, the camera biases and the noise.
        rig: The cameras.
        stations: Number of stations; by default one every step over the row's length.
        settings: Tripod and sensor errors.
        pass_number: Number of the pass along the row; passes differ in steps and noise and share the biases.
        light: Light on a row of organ meshes; sampled from the seed by default. Rows of primitives have fixed light.

    Returns:
        A recording whose stations carry their true poses, in the row's frame, and whose truth is the row.

    Raises:
        InvalidValueError: ``stations`` is not positive, or ``seed`` is negative.
    """
    settings = settings or CaptureSettings()
    count = check_whole("stations", round(row.length / settings.step) if stations is None else stations, 1)
    seed = require_seed(seed)
    light = light or draw_light(np.random.default_rng([seed, 4]))
    poses = tripod_poses(count, seed, rig, settings, pass_number)
    load = _SimulatedStations(row, seed, rig, poses, settings, pass_number, light)
    return Recording(f"simulated-{seed}", rig, count, load, truth=row)


@dataclass(frozen=True, eq=False)
class _SimulatedStations:
    """Renderer of the stations of a simulated recording."""

    row: PlantRow
    seed: int
    rig: Rig
    poses: Array
    settings: CaptureSettings
    pass_number: int
    light: Light

    @cached_property
    def _caster(self) -> RowRaycaster:
        return RowRaycaster.of(self.row, self.light)

    def __reduce__(self) -> tuple[Any, ...]:
        return _SimulatedStations, tuple(getattr(self, one.name) for one in fields(self))  # without Open3D's scene

    def __call__(self, i: int) -> Station:
        seed, number = self.seed, (self.pass_number,) if self.pass_number else ()
        biases = draw_biases(len(self.rig.cameras), np.random.default_rng([seed, 1]), self.settings.noise.bias)
        frames = {}
        for k, (name, camera) in enumerate(perturbed_rig(self.rig, seed, self.settings).cameras.items()):
            rng = np.random.default_rng([seed, 2, i, k, *number])
            light_rng = np.random.default_rng([seed, 5, i, k, *number])
            caster = replace(self._caster, light=self.light.at_station(light_rng))
            view = caster.render(self.poses[i] @ camera.rig_from_camera, camera.intrinsics)
            depth = _sense(view, camera.intrinsics.fx, rng, light_rng, self.settings, float(biases[k]))
            noise = self.settings.color_noise * rng.standard_normal(view.color.shape, dtype=np.float32)
            color = np.clip(view.color + noise, 0, 255).astype(np.uint8)
            frames[name] = RgbdFrame(color, depth, camera.intrinsics)
        return Station(frames, self.poses[i])


def _sense(
    view: View, fx: float, rng: np.random.Generator, mixing: np.random.Generator, settings: CaptureSettings, bias: float
) -> npt.NDArray[np.float32]:
    """Return the depth that a camera reports of a view; ``mixing`` is the source of mixed edges on organ meshes."""
    if isinstance(settings.noise, TimeOfFlightNoise):
        return sense_time_of_flight(view.depth, view.color, rng, settings.noise, bias)
    if view.glare is None:
        return sense_depth(view.depth, fx, rng, settings.noise, bias)
    true = mix_edges(view.depth, mixing, settings.dropout.mixed)
    dropout = dropout_probability(view.depth, view.color, view.glare, fx, settings.dropout, settings.noise.baseline)
    return sense_depth(true, fx, rng, settings.noise, bias, dropout)


def perturbed_rig(rig: Rig, seed: int, settings: CaptureSettings) -> Rig:
    """Return the rig with perturbed camera poses, which the rig file does not state."""
    rng = np.random.default_rng([seed, 3])
    cameras = {}
    for name, camera in rig.cameras.items():
        offset = rng.uniform(-settings.camera_offset, settings.camera_offset, 3)
        angles = rng.uniform(-settings.camera_angle, settings.camera_angle, 3)
        nominal = camera.rig_from_camera
        if name != rig.reference:
            turn = Rotation.from_rotvec(angles).as_matrix()
            nominal = pose(turn @ nominal[:3, :3], nominal[:3, 3] + offset)
        cameras[name] = replace(camera, rig_from_camera=nominal)
    return Rig(cameras, rig.reference)


def tripod_poses(count: int, seed: int, rig: Rig, settings: CaptureSettings, pass_number: int = 0) -> Array:
    """Sample the poses of the rig at each station, (count, 4, 4) world_from_station.

    The rig turns about the reference camera, where a tripod's head is, so angles do not add to the offsets.
    """
    rng = np.random.default_rng([seed, 0, pass_number] if pass_number else [seed, 0])
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
