"""Depth errors and places of the cameras, from the surfaces that several cameras of a station see, and fattened edges.

A stereo camera reports (1 + bias) times the depth. The cameras' axes cross in the plants, so two cameras see the same
surface from different sides; the gap between what they report, along the surface's normal, is linear in their biases
and in small motions of the cameras. Because the cameras stand a known distance apart, an error common to all of them
shows as well. Where the cameras themselves are not quite where the rig file says, part of that knowledge is lost, so
their places are only estimated if that explains the overlap notably better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import permutations
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.frames import Station
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Camera, Rig
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, invert, pose, transform
from greenhouse_gym.reconstruction.fattening import Fattening, edge_fattening
from greenhouse_gym.reconstruction.icp import tukey
from greenhouse_gym.reconstruction.point_clouds import Cloud
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.views import Calibration, CameraView, view_camera

_LIKELY = np.array([0.005, 0.01, 0.01, 0.01, 0.002, 0.002, 0.002])  # one sigma: depth error, rad, m
_COMMON = 1e-5  # one sigma of the sum of the depth errors, where the cameras' places are estimated as well
_GAP = 0.001  # m, one sigma of the gap between two readings of a surface
_HELPS = 0.98  # most of the median gap that new places of the cameras may leave; 0.99 is left where they are right
_ITERATIONS = 15  # at most; the partners within reach change with the corrections, so it converges slowly
_RELAXATION = 1.5  # times a step, which falls short while partners beyond reach are missing
_SAMPLES = 1500  # points of each camera and station
_EDGES = 1.25  # times the cut: the depth up to which edges tell of fattening
_FEWEST = 500  # gaps below which nothing is concluded


class _Sampled(NamedTuple):
    """What a camera sees, and some of it to compare with the other cameras."""

    view: CameraView
    sample: Cloud


_Stations: TypeAlias = list[Mapping[str, _Sampled]]


@dataclass(frozen=True)
class CalibrationReport:
    """What was found out about the cameras.

    Attributes:
        bias: Relative depth error by camera.
        turned: By how much each camera is turned against the rig file, radians; empty where the file was kept.
        shifted: By how much each camera is shifted against the rig file, metres; empty where the file was kept.
        gap_before: Median distance between two cameras' readings of a surface, as the rig file has them, metres.
        gap_after: That distance after the calibration, metres.
        fattening: Pixels by which near things grow over far ones along rows and columns of the depth images.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    bias: dict[str, float]
    turned: dict[str, float]
    shifted: dict[str, float]
    gap_before: float = 0.0
    gap_after: float = 0.0
    fattening: Fattening = field(default_factory=Fattening)


def calibrate(recording: Recording, settings: ReconstructionSettings) -> tuple[Calibration, CalibrationReport]:
    """Estimate depth errors, and where it helps the places of the cameras, from a few stations of a recording.

    Looks at ``settings.calibration_stations`` stations spread over the recording; those that cannot be read or share no
    surfaces add nothing. The rig and its depths are kept where there is too little to see, or a single camera; how far
    near things grow over far ones, a single camera tells as well.
    """
    rig = recording.rig
    names = list(rig.cameras)
    corrections = np.zeros((len(names), 7))
    spread = spread_stations(recording, settings)
    grown = fattening_of(spread, settings)
    unmoved = Calibration(rig, fattening=grown)
    nothing = unmoved, CalibrationReport(dict.fromkeys(names, 0.0), {}, {}, fattening=grown)
    if len(names) < 2:
        return nothing
    stations = _stations(spread, unmoved, settings)
    gaps, _ = _gaps(stations, rig, corrections, settings)
    if len(gaps) < _FEWEST:
        return nothing
    before = float(np.median(np.abs(gaps)))
    depth_only = np.zeros(corrections.shape, dtype=bool)
    depth_only[:, 0] = True
    biased, after = _fit(stations, rig, corrections, depth_only, settings)
    # a camera that sees next to nothing would take up whatever the others share
    sharing = np.count_nonzero(_gaps(stations, rig, biased, settings)[1][:, ::7], axis=0) >= _FEWEST
    if settings.calibrate_rig and np.count_nonzero(sharing) > 1:
        relative = biased - np.where(sharing[:, None], biased[sharing].mean(axis=0), 0.0)
        movable = np.repeat(sharing[:, None], 7, axis=1)
        movable[names.index(rig.reference), 1:] = False
        placed, left = _fit(stations, rig, relative, movable, settings)
        if left < _HELPS * after:
            cameras = {name: _placed(camera, placed[k]) for k, (name, camera) in enumerate(rig.cameras.items())}
            report = CalibrationReport(
                _by_name(names, placed[:, 0]),
                _by_name(names, np.linalg.norm(placed[:, 1:4], axis=1)),
                _by_name(names, np.linalg.norm(placed[:, 4:], axis=1)),
                before,
                left,
                grown,
            )
            return Calibration(Rig(cameras, rig.reference), report.bias, grown), report
    report = CalibrationReport(_by_name(names, biased[:, 0]), {}, {}, before, after, grown)
    return Calibration(rig, report.bias, grown), report


def spread_stations(recording: Recording, settings: ReconstructionSettings) -> list[Station]:
    """The stations of a recording that calibration looks at, spread over it; those that cannot be read are left out."""
    count = settings.calibration_stations if len(recording) else 0
    numbers = np.unique(np.linspace(0, len(recording) - 1, count).round().astype(int))

    def read(i: int) -> Station | None:
        try:
            return recording[i]
        except FileFormatError:
            return None  # the walk through the recording reports it

    with ThreadPoolExecutor(2) as pool:
        return [station for station in pool.map(read, numbers.tolist()) if station]


def fattening_of(stations: Sequence[Station], settings: ReconstructionSettings) -> Fattening:
    """By how much near things grow over far ones in what cameras of one kind saw, where that is to be found out."""
    if not settings.calibrate_edges:
        return Fattening()
    frames = (frame for station in stations for frame in station.frames.values())
    return edge_fattening(frames, _EDGES * settings.foreground)


def _by_name(names: list[str], values: Array) -> dict[str, float]:
    return {name: round(float(value), 9) for name, value in zip(names, values, strict=True)}


def _placed(camera: Camera, correction: Array) -> Camera:
    """The camera turned and shifted by a correction (7,): depth error, rotation vector, translation."""
    turn, there = Rotation.from_rotvec(correction[1:4]).as_matrix(), camera.rig_from_camera
    moved = np.round(pose(turn @ there[:3, :3], there[:3, 3] + correction[4:]), 12)
    return Camera(camera.intrinsics, moved, camera.depth_scale)


def _stations(stations: Sequence[Station], known: Calibration, settings: ReconstructionSettings) -> _Stations:
    def look(station: Station) -> Mapping[str, _Sampled]:
        views = {name: view_camera(frame, name, known, settings) for name, frame in station.frames.items()}
        return {name: _Sampled(view, view.sample(_SAMPLES)) for name, view in views.items()}

    with ThreadPoolExecutor(2) as pool:
        return [*pool.map(look, stations)]


def _fit(
    stations: _Stations,
    rig: Rig,
    corrections: Array,
    free: npt.NDArray[np.bool_],
    settings: ReconstructionSettings,
) -> tuple[Array, float]:
    """Corrections (cameras, 7) that close the gaps best, some of them free, and the median gap they leave."""
    chosen = np.flatnonzero(free)
    likely = np.tile(_LIKELY, len(corrections))
    for _ in range(_ITERATIONS):
        gaps, jacobian = _gaps(stations, rig, corrections, settings)
        weighted = (jacobian * (tukey(gaps) / _GAP**2)[:, None])[:, chosen]
        matrix = jacobian.T[chosen] @ weighted + np.diag(1 / likely[chosen] ** 2)
        right = -weighted.T @ gaps - (corrections.ravel() / likely**2)[chosen]
        if free[:, 1:].any():  # a common depth error could not be told from cameras farther apart
            common = np.isin(chosen, np.arange(0, corrections.size, 7)).astype(np.float64)
            matrix += np.outer(common, common) / _COMMON**2
            right -= common * corrections[:, 0].sum() / _COMMON**2
        step = np.zeros(corrections.size)
        step[chosen] = _RELAXATION * np.linalg.solve(matrix, right)
        corrections = corrections + step.reshape(corrections.shape)
        if np.abs(step).max() < 2e-5:
            break
    gaps, _ = _gaps(stations, rig, corrections, settings)
    return corrections, float(np.median(np.abs(gaps)))


def _gaps(stations: _Stations, rig: Rig, corrections: Array, settings: ReconstructionSettings) -> tuple[Array, Array]:
    """Gaps (n,) between two cameras' readings along the surface, and their derivative by the corrections (n, 7 c)."""
    names = list(rig.cameras)
    gaps, jacobians = [np.zeros(0)], [np.zeros((0, corrections.size))]
    seen_by = {name: _placed(rig.cameras[name], corrections[k]) for k, name in enumerate(names)}
    for views in stations:
        samples = {
            name: _corrected(views[name].sample, rig.cameras[name], corrections[k]) for k, name in enumerate(names)
        }
        for one, two in permutations(names, 2):
            i, j = names.index(one), names.index(two)
            a, view = samples[one], views[two].view
            in_camera = transform(invert(seen_by[two].rig_from_camera), a.points)
            row, v, u = seen_by[two].intrinsics.project(in_camera)
            shown = view.foreground[v, u]
            a = a.select(row[shown])
            b = _corrected(view.cloud(v[shown], u[shown]), rig.cameras[two], corrections[j])
            axis = a.normals + b.normals
            axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
            apart = a.points - b.points
            near = np.linalg.norm(apart, axis=1) < settings.fine_distance
            near &= (a.normals * b.normals).sum(axis=1) > settings.facing
            a, b, axis, apart = a.select(near), b.select(near), axis[near], apart[near]
            jacobian = np.zeros((len(axis), len(names), 7))
            for k, cloud, sign in ((i, a, 1.0), (j, b, -1.0)):
                rays = cloud.points - rig.cameras[names[k]].rig_from_camera[:3, 3]
                jacobian[:, k, 0] = -sign * (rays * axis).sum(axis=1)
                jacobian[:, k, 1:4] = sign * np.cross(rays, axis)
                jacobian[:, k, 4:] = sign * axis
            gaps.append((apart * axis).sum(axis=1))
            jacobians.append(jacobian.reshape(len(axis), corrections.size))
    return np.concatenate(gaps), np.concatenate(jacobians)


def _corrected(cloud: Cloud, camera: Camera, correction: Array) -> Cloud:
    """A camera's cloud with a correction (7,) applied: depths divided, then turned about the camera, then shifted."""
    turn, origin = Rotation.from_rotvec(correction[1:4]).as_matrix(), camera.rig_from_camera[:3, 3]
    points = (cloud.points - origin) / (1.0 + correction[0]) @ turn.T + origin + correction[4:]
    return Cloud(points, cloud.colors, cloud.normals @ turn.T)
