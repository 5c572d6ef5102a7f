"""What a camera on the arm saw before it reached, added to the cloud of the row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.errors import InvalidValueError, ReconstructionError
from greenhouse_gym.geometry import Array, invert
from greenhouse_gym.reconstruction.calibration import fattening_of, spread_stations
from greenhouse_gym.reconstruction.fitting import settings_for
from greenhouse_gym.reconstruction.graph import Edge
from greenhouse_gym.reconstruction.joining import register_near
from greenhouse_gym.reconstruction.merging import lonely_points
from greenhouse_gym.reconstruction.point_clouds import Cloud, merge, voxel_means
from greenhouse_gym.reconstruction.row import Look, RowCloud
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.views import Calibration, view_station

_NEAREST = 3  # stations of the row that a look is registered to, one after the other, until one convinces
_KNOWN = 2.0  # voxels; what lies nearer to a point of the row says nothing new


def add_looks(
    row: RowCloud,
    recording: Recording,
    looks: Recording,
    row_from_stand: Array,
    settings: ReconstructionSettings | None = None,
) -> tuple[RowCloud, Array]:
    """Add what the arm's camera saw from its stands to a row.

    The images of one stand share the arm's kinematics, so they are registered as one station whose cameras stand where
    the arm held its camera; how far off the arm stands, ICP finds from the nearest stations of the row.
    Only what lies off all points of the row is added: the scan saw the rest from more sides.

    Args:
        row: The reconstructed row.
        recording: What it was reconstructed from.
        looks: A station for each stand; its rig has a camera for each configuration the arm looked from.
        row_from_stand: (stands, 4, 4) where the arm stands in the row's frame, right to a centimetre or two.
        settings: Those of the row's reconstruction; by default what the recording's protocol needs.

    Returns:
        The row with the added points, and the (stands, 4, 4) poses that registration found.

    Raises:
        InvalidValueError: A pose for each stand is not given, or not finite.
        ReconstructionError: What the arm saw from a stand agrees with no station near it.
    """
    settings = settings or settings_for(recording)
    nominal = np.asarray(row_from_stand, dtype=np.float64)
    if nominal.shape != (len(looks), 4, 4) or not np.isfinite(nominal).all():
        raise InvalidValueError(
            f"looks {looks.name!r}: expected a finite (4, 4) pose of the arm's stand for each of {len(looks)} stands, "
            f"got an array of shape {nominal.shape} with {(~np.isfinite(nominal)).sum()} numbers that are not finite"
        )
    known = Calibration(recording.rig, row.report.calibration.bias, row.report.calibration.fattening)
    grown = fattening_of(spread_stations(looks, settings), settings)
    found = np.empty_like(nominal)
    seen: list[Cloud] = []
    sights: list[Look] = []
    for k, start in enumerate(nominal):
        nearest = _nearest(row, start)
        depth = row.world_from_station[nearest[0], 0, 3] + _reference_x(recording.rig) + settings.foreground
        cut = replace(settings, foreground=float(depth - start[0, 3] - _reference_x(looks.rig)))
        look = view_station(looks[k], Calibration(looks.rig, fattening=grown), cut)
        reasons = []
        for i in nearest:
            station = view_station(recording[i], known, settings)
            row_from_station = row.world_from_station[i]
            edge = register_near(station, look, invert(row_from_station) @ start, settings)
            if isinstance(edge, Edge):
                found[k] = row_from_station @ edge.first_from_second
                break
            reasons.append(f"station {i}: {edge}")
        else:
            raise ReconstructionError(f"looks {looks.name!r}: stand {k} fits no station near it. {'; '.join(reasons)}")
        sights.append(Look(found[k], looks.rig, {name: camera.screen() for name, camera in look.cameras.items()}))
        seen.append(voxel_means(look.cloud().moved(found[k]), settings.voxel)[0])
    sight = None if row.sight is None else replace(row.sight, looks=(*row.sight.looks, *sights))
    return replace(_with_new(row, merge(seen), settings), sight=sight), found


def _reference_x(rig: Rig) -> float:
    return float(rig.cameras[rig.reference].rig_from_camera[0, 3])


def _nearest(row: RowCloud, row_from_stand: Array) -> list[int]:
    registered = np.flatnonzero(row.registered)
    away = np.abs(row.world_from_station[registered, 1, 3] - row_from_stand[1, 3])
    return [int(i) for i in registered[np.argsort(away, kind="stable")[:_NEAREST]]]


def _with_new(row: RowCloud, seen: Cloud, settings: ReconstructionSettings) -> RowCloud:
    """The row and those points that lie off all of its own."""
    away, _ = cKDTree(row.points).query(seen.points, distance_upper_bound=_KNOWN * settings.voxel)
    new = voxel_means(seen.select(np.isinf(away)), settings.voxel)[0]
    new = new.select(~lonely_points(new.points, settings))
    whole = merge([row, new])
    station = np.concatenate([row.station, row.station[cKDTree(row.points).query(new.points)[1]]]).astype(np.int32)
    report = replace(row.report, points=len(whole))
    return RowCloud(whole.points, whole.colors, whole.normals, station, row.registered, row.world_from_station, report)
