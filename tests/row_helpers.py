"""A short simulated row, rendered and reconstructed once per test process, and recordings made of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture import Intrinsics, Recording, RgbdFrame, Station, simulate_recording, three_camera_rig
from greenhouse_gym.crops import PlantRow, grow_row
from greenhouse_gym.geometry import Array, invert, rotation_angle, transform
from greenhouse_gym.reconstruction import RowCloud, reconstruct_row

HALF = three_camera_rig(Intrinsics(424, 240, 212.1, 212.1, 211.5, 119.5))
"""The rig with a quarter of the pixels."""


def from_stations(stations: Sequence[Station], like: Recording) -> Recording:
    return replace(like, size=len(stations), load=stations.__getitem__)


@cache
def grown() -> PlantRow:
    return grow_row(seed=1, length=0.5)


@cache
def full_recording() -> Recording:
    """Five stations of the half metre of `grown`, as `SEED_RIG` sees them."""
    return rendered(simulate_recording(grown(), seed=1))


@cache
def half_recording() -> Recording:
    """The same walk with a quarter of the pixels."""
    return rendered(simulate_recording(grown(), seed=1, rig=HALF))


def rendered(simulated: Recording) -> Recording:
    """A simulated recording whose stations are rendered once and kept."""
    return from_stations(list(simulated), simulated)


def true_poses(recording: Recording) -> Array:
    poses = [station.world_from_station for station in recording]
    assert all(pose is not None for pose in poses)
    return np.array(poses, dtype=np.float64)


@cache
def full_cloud() -> RowCloud:
    return reconstruct_row(full_recording())


@cache
def half_cloud() -> RowCloud:
    return reconstruct_row(half_recording())


def worst_errors(row: RowCloud, recording: Recording) -> tuple[float, float]:
    """Of the registered stations' poses relative to the first of them: metres at the reference camera, degrees."""
    good = np.flatnonzero(row.registered)
    true, found = true_poses(recording)[good], row.world_from_station[good]
    true, found = invert(true[0]) @ true, invert(found[0]) @ found
    pairs = list(zip(true, found, strict=True))
    head = recording.rig.cameras[recording.rig.reference].rig_from_camera[:3, 3]
    metres = [np.linalg.norm(transform(a, head[None]) - transform(b, head[None])) for a, b in pairs]
    radians = [rotation_angle(a[:3, :3].T @ b[:3, :3]) for a, b in pairs]
    return float(max(metres)), float(np.degrees(max(radians)))


Depth = npt.NDArray[np.float32]


def with_depth(station: Station, change: Callable[[str, Depth], Depth]) -> Station:
    """The station with the depth that ``change`` makes of each camera's, given its name."""
    frames = {
        name: RgbdFrame(frame.color, change(name, frame.depth).astype(np.float32), frame.intrinsics)
        for name, frame in station.frames.items()
    }
    return Station(frames, station.world_from_station)


def black(station: Station) -> Station:
    """The station without a single depth reading."""
    return with_depth(station, lambda _, depth: np.zeros_like(depth))
