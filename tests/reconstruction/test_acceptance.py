"""Motions that the geometry does not constrain are refused: along a wall, a table, a pole."""

from __future__ import annotations

import numpy as np
import pytest
from row_helpers import HALF, half_recording, true_poses

from greenhouse_gym.capture import Camera, RgbdFrame, Rig, Station, sense_depth
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.geometry import Array, invert, pose, rotation_about, rotation_angle
from greenhouse_gym.reconstruction import ReconstructionSettings, station_views
from greenhouse_gym.reconstruction.icp import fine_icp
from greenhouse_gym.reconstruction.pair_registration import alignment_problem
from greenhouse_gym.reconstruction.station_views import Calibration, station_view

CREDULOUS = ReconstructionSettings(foreground=0.9, min_fitness=0.0, max_rmse=1.0, max_contradicted=1.0, min_overlap=0.0)
LOOSE = {"wall": 3, "table": 3, "pole": 2}


def rig(pitch: float = 0.0) -> Rig:
    """A single camera at 1.1 m that looks ahead, or down by ``pitch`` radians."""
    ahead = HALF.cameras["middle"].rig_from_camera
    turned = pose(rotation_about([0.0, 1.0, 0.0], pitch) @ ahead[:3, :3], ahead[:3, 3])
    return Rig({"middle": Camera(HALF.cameras["middle"].intrinsics, turned)}, "middle")


def things(name: str) -> list[object]:
    make = open3d().t.geometry.TriangleMesh
    if name == "wall":
        return [make.create_box(0.1, 6.0, 6.0).translate([0.5, -3.0, -2.0])]
    if name == "table":
        return [make.create_box(6.0, 6.0, 0.1).translate([0.0, -3.0, 0.6])]
    return [make.create_cylinder(0.03, 6.0).translate([0.5, 0.0, 1.0])]


def photographed(name: str, world_from_station: Array, seed: int, on: Rig) -> Station:
    scene = open3d().t.geometry.RaycastingScene()
    for mesh in things(name):
        scene.add_triangles(mesh)
    camera = on.cameras["middle"]
    k = camera.intrinsics
    rays = scene.create_rays_pinhole(k.matrix, invert(world_from_station @ camera.rig_from_camera), k.width, k.height)
    depth = sense_depth(scene.cast_rays(rays)["t_hit"].numpy(), k.fx, np.random.default_rng(seed))
    return Station({"middle": RgbdFrame(np.full((*depth.shape, 3), 128, np.uint8), depth, k)}, world_from_station)


@pytest.mark.parametrize("normal_window", [5, 7, 11])
@pytest.mark.parametrize("name", LOOSE)
def test_what_can_slide_or_turn_is_refused(monkeypatch: pytest.MonkeyPatch, name: str, normal_window: int) -> None:
    on = rig(0.9 if name == "table" else 0.0)
    monkeypatch.setattr(station_views, "NORMAL_WINDOW", normal_window)
    moved = pose(rotation_about([0, 0, 1], 0.02), [0.0, 0.05, 0.0])
    first, second = (
        station_view(photographed(name, place, seed, on), Calibration(on), CREDULOUS)
        for seed, place in enumerate((np.eye(4), moved))
    )
    found = fine_icp(first, second.sample, moved, CREDULOUS)
    assert found.fitness > 0.5
    assert (found.constraint < 0.05).sum() >= LOOSE[name]
    assert "too even" in alignment_problem(found, CREDULOUS)


def test_a_row_constrains_all_motions() -> None:
    recording, poses = half_recording(), true_poses(half_recording())
    views = [station_view(recording[i], Calibration(HALF), ReconstructionSettings()) for i in (0, 2)]
    true = invert(poses[0]) @ poses[2]
    found = fine_icp(views[0], views[1].sample, true, ReconstructionSettings())
    assert alignment_problem(found, ReconstructionSettings()) == ""
    assert found.constraint[0] > 0.006
    assert found.constraint[1] > 0.1
    apart = invert(true) @ found.first_from_second
    assert rotation_angle(apart[:3, :3]) < 0.01
