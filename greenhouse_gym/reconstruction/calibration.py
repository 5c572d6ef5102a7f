"""Calibration of depth errors, camera poses and edge fattening from surfaces that several cameras of a station see.

A stereo camera reports (1 + bias) times the depth. The cameras' axes cross in the plants, so two cameras see the same
surface from different sides; the gap between their readings, along the surface's normal, is linear in their biases and
in small motions of the cameras. Because the cameras stand a known distance apart, an error common to all of them shows
as well. Where the camera poses are wrong, part of that knowledge is lost, so poses are estimated only if that explains
the overlap notably better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import permutations, product
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Camera, RgbdFrame, Rig, Station
from greenhouse_gym.capture.rig_file import Mounting
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.geometry import Array, invert, pose, transform
from greenhouse_gym.geometry.point_clouds import Cloud
from greenhouse_gym.reconstruction.edge_fattening import EdgeFattening, estimate_edge_fattening
from greenhouse_gym.reconstruction.icp import MIN_FACING, tukey_weights
from greenhouse_gym.reconstruction.report import CalibrationReport
from greenhouse_gym.reconstruction.settings import ReconstructionSettings, settings_for
from greenhouse_gym.reconstruction.station_views import Calibration, CameraView, camera_view

_PRIOR = np.array([0.005, 0.01, 0.01, 0.01, 0.002, 0.002, 0.002])  # one sigma: depth error, rad, m
_COMMON_PRIOR = 1e-5  # one sigma of the sum of the depth errors, where camera poses are estimated as well
_GAP_SIGMA = 0.001  # m, of the gap between two readings of a surface
_REQUIRED_GAIN = 0.98  # of the median gap, below which new camera poses must bring it; correct ones reach 0.99
_ITERATIONS = 15  # at most; the partners within reach change with the corrections, so convergence is slow
_RELAXATION = 1.5  # times a step, which falls short while partners beyond reach are missing
_SAMPLES = 1500  # points of each camera and station
_EDGE_DEPTH = 1.25  # times the cut: maximum depth of edges that count for fattening
_MIN_GAPS = 500  # for an estimate

_DISTANCES = (0.03, 0.015, 0.005)  # m within which surfaces are paired, one calibration after the other
_STATIONS = 8
_SEARCH_STATIONS = 4  # by which a displaced camera is searched for
_EVERY = 6  # rows and columns of an image that are compared then
_TURNS = ((-0.07, -0.035, 0.0, 0.035, 0.07), (-0.0175, 0.0, 0.0175), (-0.009, 0.0, 0.009))  # rad, about each axis
_SAME_DEPTH = 0.008  # m between two readings of a point
_REQUIRED_RIG_GAIN = 1.15  # times as many readings must agree before a camera is taken as displaced


class _Sampled(NamedTuple):
    """A camera's view, and a sample of it to compare with the other cameras."""

    view: CameraView
    sample: Cloud


_Stations: TypeAlias = list[Mapping[str, _Sampled]]


def calibrate(recording: Recording, settings: ReconstructionSettings) -> tuple[Calibration, CalibrationReport]:
    """Estimate depth errors, and where it helps the camera poses, from a subset of the stations of a recording.

    Uses ``settings.calibration_stations`` stations spread over the recording; those that cannot be read or share no
    surfaces add nothing. The rig and its depths are kept where the overlap is too small, or with a single camera; edge
    fattening is estimated in any case.
    """
    rig = recording.rig
    names = list(rig.cameras)
    corrections = np.zeros((len(names), 7))
    spread = _spread_stations(recording, settings)
    fattening = _edge_fattening(spread, settings)
    unchanged = Calibration(rig, edge_fattening=fattening)
    nothing = unchanged, CalibrationReport(dict.fromkeys(names, 0.0), {}, {}, edge_fattening=fattening)
    if len(names) < 2:
        return nothing
    stations = _sampled_stations(spread, unchanged, settings)
    gaps, _ = _gaps(stations, rig, corrections, settings)
    if len(gaps) < _MIN_GAPS:
        return nothing
    before = float(np.median(np.abs(gaps)))
    depth_only = np.zeros(corrections.shape, dtype=bool)
    depth_only[:, 0] = True
    biased, after = _fit(stations, rig, corrections, depth_only, settings)
    # a camera with almost no overlap would absorb whatever the others share
    sharing = np.count_nonzero(_gaps(stations, rig, biased, settings)[1][:, ::7], axis=0) >= _MIN_GAPS
    if settings.calibrate_rig and np.count_nonzero(sharing) > 1:
        relative = biased - np.where(sharing[:, None], biased[sharing].mean(axis=0), 0.0)
        movable = np.repeat(sharing[:, None], 7, axis=1)
        movable[names.index(rig.reference), 1:] = False
        moved, left = _fit(stations, rig, relative, movable, settings)
        if left < _REQUIRED_GAIN * after:
            cameras = {name: _corrected_camera(rig.cameras[name], moved[k]) for k, name in enumerate(names)}
            turned, shifted = (_by_name(names, np.linalg.norm(part, axis=1)) for part in (moved[:, 1:4], moved[:, 4:]))
            report = CalibrationReport(_by_name(names, moved[:, 0]), turned, shifted, before, left, fattening)
            return Calibration(Rig(cameras, rig.reference), report.bias, fattening), report
    report = CalibrationReport(_by_name(names, biased[:, 0]), {}, {}, before, after, fattening)
    return Calibration(rig, report.bias, fattening), report


def _spread_stations(recording: Recording, settings: ReconstructionSettings) -> list[Station]:
    """Read the stations that calibration uses, spread over a recording; those that cannot be read are left out."""
    count = settings.calibration_stations if len(recording) else 0
    numbers = np.unique(np.linspace(0, len(recording) - 1, count).round().astype(int))

    def read(i: int) -> Station | None:
        try:
            return recording[i]
        except FileFormatError:
            return None  # station registration reports it

    with ThreadPoolExecutor(2) as pool:
        return [station for station in pool.map(read, numbers.tolist()) if station]


def _edge_fattening(stations: Sequence[Station], settings: ReconstructionSettings) -> EdgeFattening:
    if not settings.calibrate_edges:
        return EdgeFattening()
    frames = (frame for station in stations for frame in station.frames.values())
    return estimate_edge_fattening(frames, _EDGE_DEPTH * settings.foreground)


def _by_name(names: list[str], values: Array) -> dict[str, float]:
    return {name: round(float(value), 9) for name, value in zip(names, values, strict=True)}


def _corrected_camera(camera: Camera, correction: Array) -> Camera:
    """Turn and shift a camera by a correction (7,): depth error, rotation vector, translation."""
    turn, nominal = Rotation.from_rotvec(correction[1:4]).as_matrix(), camera.rig_from_camera
    corrected = np.round(pose(turn @ nominal[:3, :3], nominal[:3, 3] + correction[4:]), 12)
    return replace(camera, rig_from_camera=corrected)


def _sampled_stations(stations: Sequence[Station], known: Calibration, settings: ReconstructionSettings) -> _Stations:
    def sampled(station: Station) -> Mapping[str, _Sampled]:
        views = {name: camera_view(frame, name, known, settings) for name, frame in station.frames.items()}
        return {name: _Sampled(view, view.sample(_SAMPLES)) for name, view in views.items()}

    with ThreadPoolExecutor(2) as pool:
        return [*pool.map(sampled, stations)]


def _fit(
    stations: _Stations,
    rig: Rig,
    corrections: Array,
    free: npt.NDArray[np.bool_],
    settings: ReconstructionSettings,
) -> tuple[Array, float]:
    """Fit the free ones of the corrections (cameras, 7) to close the gaps; return all, and the median gap left."""
    chosen = np.flatnonzero(free)
    prior = np.tile(_PRIOR, len(corrections))
    for _ in range(_ITERATIONS):
        gaps, jacobian = _gaps(stations, rig, corrections, settings)
        weighted = (jacobian * (tukey_weights(gaps) / _GAP_SIGMA**2)[:, None])[:, chosen]
        matrix = jacobian.T[chosen] @ weighted + np.diag(1 / prior[chosen] ** 2)
        right = -weighted.T @ gaps - (corrections.ravel() / prior**2)[chosen]
        if free[:, 1:].any():  # a common depth error looks the same as cameras farther apart
            common = np.isin(chosen, np.arange(0, corrections.size, 7)).astype(np.float64)
            matrix += np.outer(common, common) / _COMMON_PRIOR**2
            right -= common * corrections[:, 0].sum() / _COMMON_PRIOR**2
        step = np.zeros(corrections.size)
        step[chosen] = _RELAXATION * np.linalg.solve(matrix, right)
        corrections = corrections + step.reshape(corrections.shape)
        if np.abs(step).max() < 2e-5:
            break
    gaps, _ = _gaps(stations, rig, corrections, settings)
    return corrections, float(np.median(np.abs(gaps)))


def _gaps(stations: _Stations, rig: Rig, corrections: Array, settings: ReconstructionSettings) -> tuple[Array, Array]:
    """Return gaps (n,) between two cameras' readings of a surface, and their derivatives by corrections (n, 7 c)."""
    names = list(rig.cameras)
    gaps, jacobians = [np.zeros(0)], [np.zeros((0, corrections.size))]
    corrected = {name: _corrected_camera(rig.cameras[name], corrections[k]) for k, name in enumerate(names)}
    for views in stations:
        samples = {
            name: _corrected_cloud(views[name].sample, rig.cameras[name], corrections[k])
            for k, name in enumerate(names)
        }
        for one, two in permutations(names, 2):
            i, j = names.index(one), names.index(two)
            a, view = samples[one], views[two].view
            in_camera = transform(invert(corrected[two].rig_from_camera), a.points)
            row, v, u = corrected[two].intrinsics.project(in_camera)
            shown = view.foreground[v, u]
            a = a.select(row[shown])
            b = _corrected_cloud(view.cloud(v[shown], u[shown]), rig.cameras[two], corrections[j])
            axis = a.normals + b.normals
            axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
            difference = a.points - b.points
            near = np.linalg.norm(difference, axis=1) < settings.fine_distance
            near &= (a.normals * b.normals).sum(axis=1) > MIN_FACING
            a, b, axis, difference = a.select(near), b.select(near), axis[near], difference[near]
            jacobian = np.zeros((len(axis), len(names), 7))
            for k, cloud, sign in ((i, a, 1.0), (j, b, -1.0)):
                rays = cloud.points - rig.cameras[names[k]].rig_from_camera[:3, 3]
                jacobian[:, k, 0] = -sign * (rays * axis).sum(axis=1)
                jacobian[:, k, 1:4] = sign * np.cross(rays, axis)
                jacobian[:, k, 4:] = sign * axis
            gaps.append((difference * axis).sum(axis=1))
            jacobians.append(jacobian.reshape(len(axis), corrections.size))
    return np.concatenate(gaps), np.concatenate(jacobians)


def _corrected_cloud(cloud: Cloud, camera: Camera, correction: Array) -> Cloud:
    """Apply a correction (7,) to a camera's cloud: divide depths, turn about the camera, shift."""
    turn, origin = Rotation.from_rotvec(correction[1:4]).as_matrix(), camera.rig_from_camera[:3, 3]
    points = (cloud.points - origin) / (1.0 + correction[0]) @ turn.T + origin + correction[4:]
    return Cloud(points, cloud.colors, cloud.normals @ turn.T)


class OverlapCalibration(NamedTuple):
    """Camera poses, their rotation and translation against the rig (rad, m), and the gap that is left, m."""

    mounting: Mounting
    turned: dict[str, float]
    shifted: dict[str, float]
    gap: float


def calibrate_from_overlap(recording: Recording) -> OverlapCalibration:
    """Estimate camera poses with ever smaller distances, after a search for cameras turned by up to four degrees.

    Raises:
        InvalidValueError: The cameras see too little in common.
    """
    settings = replace(settings_for(recording), calibration_stations=_STATIONS, calibrate_rig=True)
    current = replace(recording, rig=_searched_rig(recording, settings.foreground))
    bias, gap = dict.fromkeys(recording.rig.cameras, 0.0), 0.0
    for distance in _DISTANCES:
        found, report = calibrate(current, replace(settings, fine_distance=max(distance, settings.fine_distance)))
        current, bias, gap = replace(current, rig=found.rig), dict(report.bias), report.gap_after
    if not gap:
        raise InvalidValueError(
            f"recording {recording.name!r}: the cameras {', '.join(recording.rig.cameras)} see too little in common"
        )
    mounting = replace(Mounting.of(current.rig), depth_error=bias)
    return OverlapCalibration(mounting, *mounting.difference(recording.rig), gap)


def _searched_rig(recording: Recording, foreground: float) -> Rig:
    """Turn each camera so that clearly more of its readings agree with those of the reference camera."""
    chosen = np.unique(np.linspace(0, len(recording) - 1, _SEARCH_STATIONS).round().astype(int))
    stations = [recording[i].frames for i in chosen.tolist()]
    rig = recording.rig
    reference = rig.cameras[rig.reference]
    cameras = dict(rig.cameras)
    for name in rig.cameras.keys() - {rig.reference}:
        pairs = [(frames[name], frames[rig.reference]) for frames in stations]
        points = [tuple(frame.grid_points(_EVERY, foreground) for frame in pair) for pair in pairs]
        before = best = _agreeing(cameras[name], reference, pairs, points)
        best_pose = cameras[name].rig_from_camera
        for turns in _TURNS:
            start = best_pose
            for turn in product(turns, repeat=3):
                turned = start @ pose(Rotation.from_rotvec(turn).as_matrix())
                agreeing = _agreeing(replace(cameras[name], rig_from_camera=turned), reference, pairs, points)
                if agreeing > best:
                    best, best_pose = agreeing, turned
        if best > _REQUIRED_RIG_GAIN * before:
            cameras[name] = replace(cameras[name], rig_from_camera=best_pose)
    return Rig(cameras, rig.reference)


def _agreeing(
    camera: Camera,
    reference: Camera,
    pairs: Sequence[tuple[RgbdFrame, RgbdFrame]],
    points: Sequence[tuple[Array, ...]],
) -> int:
    """Count the readings of either camera that the other one has at the same depth."""
    reference_from_camera = invert(reference.rig_from_camera) @ camera.rig_from_camera
    count = 0
    for (own, other), (own_points, other_points) in zip(pairs, points, strict=True):
        for target, moved in (
            (other, transform(reference_from_camera, own_points)),
            (own, transform(invert(reference_from_camera), other_points)),
        ):
            kept, rows, columns = target.intrinsics.project(moved)
            difference = np.abs(target.depth[rows, columns] - moved[kept, 2])
            count += int(np.count_nonzero(difference < _SAME_DEPTH))
    return count
