"""Stages of the demo from the plants to their shapes, each with its pictures and figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from greenhouse_gym.cli.demo import DemoReport, DemoSettings
from greenhouse_gym.common.progress import progress

if TYPE_CHECKING:
    from greenhouse_gym.capture import Recording
    from greenhouse_gym.crops import PlantRow
    from greenhouse_gym.reconstruction import RowCloud
    from greenhouse_gym.shapes import RowShapes


def simulate(out: Path, seed: int, settings: DemoSettings, report: DemoReport) -> tuple[PlantRow, Recording]:
    """Grow a row and record it; return the row and the recording read from its files."""
    from greenhouse_gym.capture import open_recording, simulate_recording, write_recording
    from greenhouse_gym.capture.formats.own import INDEX
    from greenhouse_gym.crops import grow_row

    with report.stage("simulate a row") as results:
        row = grow_row(seed, settings.length)
        simulated = simulate_recording(row, seed)
        (out / "recording" / INDEX).unlink(missing_ok=True)  # of an earlier demo
        with progress("stations", len(simulated)) as on_progress:
            write_recording(simulated, out / "recording", lambda i: on_progress(i + 1))
        results += [f"{settings.length:g} m", f"{len(simulated)} stations", f"{len(row.tomatoes)} tomatoes grown"]
    return row, open_recording(out / "recording")


def reconstruct(out: Path, row: PlantRow, recording: Recording, report: DemoReport) -> RowCloud:
    """Reconstruct the recording, draw each step, and compare the cloud with the truth."""
    from greenhouse_gym.accuracy import distance_to_truth, drift
    from greenhouse_gym.reconstruction import ReconstructionSettings, save_row, simplify_points, triangulate
    from greenhouse_gym.reconstruction.row_cloud import merge_segment, remove_outliers
    from greenhouse_gym.reconstruction.station_registration import register_stations
    from greenhouse_gym.reporting.pictures import registration_pictures, row_pictures

    settings = ReconstructionSettings()
    with report.stage("reconstruct") as results:
        with progress("stations", len(recording)) as on_progress:
            stations = register_stations(recording, settings, lambda i: on_progress(i + 1))
        merged, outlier = merge_segment(stations, 0, settings)
        cloud = remove_outliers(merged, outlier)
        simplified = simplify_points(cloud)
        mesh = triangulate(simplified)
        save_row(cloud, out / "row.npz")
        results += [
            f"{cloud.registered.sum()} of {len(cloud.registered)} stations registered",
            f"{len(cloud)} points, simplified to {len(simplified)}, {len(mesh.triangles)} faces",
        ]
    with report.stage("pictures of the reconstruction") as results:
        middle = len(recording) // 2
        paths = registration_pictures(recording, middle - 1, middle, stations.calibration, settings, out)
        paths += row_pictures(merged, cloud, mesh, out)
        results.append(f"{len(paths)} pictures")
    with report.stage("compare with the truth") as results:
        poses = true_poses(recording)
        error = drift(cloud, poses)
        first = int(np.flatnonzero(cloud.registered)[0])
        distance = distance_to_truth(cloud, row, poses[first])
        results += [
            f"drift {error.fraction:.2%} of {error.length:.2f} m",
            f"cloud to truth {1e3 * distance.mean():.1f} mm mean, {1e3 * np.quantile(distance, 0.95):.1f} mm at 95 %",
        ]
        report.figures |= {
            "stations": len(cloud.registered),
            "stations_registered": int(cloud.registered.sum()),
            "drift": error.fraction,
            "cloud_to_truth_mean": float(distance.mean()),
            "cloud_to_truth_95": float(np.quantile(distance, 0.95)),
            "points": len(cloud),
            "simplified_points": len(simplified),
            "faces": len(mesh.triangles),
        }
    return cloud


def true_poses(recording: Recording) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the true poses (stations, 4, 4) of a simulated recording, NaN where a station has none."""
    poses = [station.world_from_station for station in recording]
    return np.array([np.full((4, 4), np.nan) if pose is None else pose for pose in poses])


def extract(out: Path, row: PlantRow, recording: Recording, cloud: RowCloud, report: DemoReport) -> RowShapes:
    """Fit shapes to the cloud, and count the visible tomatoes that were found."""
    from greenhouse_gym.accuracy import match_tomatoes, visible_tomatoes
    from greenhouse_gym.geometry import invert
    from greenhouse_gym.rendering.picture_files import write_picture
    from greenhouse_gym.reporting.pictures import shapes_over_photograph, upright
    from greenhouse_gym.shapes import extract_shapes

    with report.stage("extract shapes") as results:
        shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals)
        results.append(f"{len(shapes.tomatoes)} tomatoes, {len(shapes.stems)} stems, {len(shapes.clutter)} boxes")
        registered = np.flatnonzero(cloud.registered)
        picture = shapes_over_photograph(recording, cloud, shapes, int(registered[len(registered) // 2]))
        write_picture(upright(picture), out / "12-shapes-over-photograph.png")
    with report.stage("count the visible tomatoes") as results:
        poses = true_poses(recording)
        visible = visible_tomatoes(row, recording.rig, poses)
        first_from_world = invert(poses[int(np.flatnonzero(cloud.registered)[0])])
        true = [tomato.transformed(first_from_world) for tomato in row.tomatoes]
        matches = match_tomatoes(true, shapes.tomatoes)
        found = int(visible[matches.true].sum())
        false = len(shapes.tomatoes) - len(matches.found)
        results += [
            f"{found} of {visible.sum()} visible tomatoes found ({found / max(visible.sum(), 1):.0%}), {false} false",
            f"center {1e3 * np.median(matches.center_errors):.1f} mm",
            f"diameter {np.median(matches.diameter_errors):.1%}",
        ]
        report.figures |= {
            "visible_tomatoes": int(visible.sum()),
            "visible_tomatoes_found": found,
            "false_tomatoes": false,
            "center_error_median": float(np.median(matches.center_errors)),
            "diameter_error_median": float(np.median(matches.diameter_errors)),
        }
    return shapes
