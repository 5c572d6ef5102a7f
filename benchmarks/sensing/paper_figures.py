"""Reproduce every figure and number of the paper from one simulated stations of 50 stations along a 5 m row.

python -m benchmarks.sensing.paper_figures --seed 204

Pictures are written to benchmarks/results/paper_figures/, numbered as in the paper, and the numbers with the paper's to
benchmarks/results/paper_figures.json. ``--recording`` reads a recording instead of rendering one. Takes 5 minutes.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.common import RESULTS, parser, table, write_results
from greenhouse_gym.build.scenes import BuildSettings, cut_scenes
from greenhouse_gym.capture import Recording, open_recording, simulate_recording, write_recording
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.common.progress import progress
from greenhouse_gym.crops import grow_row
from greenhouse_gym.geometry import Array, transform
from greenhouse_gym.planning import PlanResult, goal_configurations, plan, resample
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, simplify_points, triangulate
from greenhouse_gym.reconstruction.row_cloud import merge_segment, remove_outliers
from greenhouse_gym.reconstruction.station_registration import register_stations
from greenhouse_gym.reconstruction.station_views import Calibration
from greenhouse_gym.rendering.renderer import Viewpoint, default_camera, render_scene
from greenhouse_gym.rendering.task_pictures import picture_of_path
from greenhouse_gym.reporting.pictures import Image, registration_pictures, row_pictures, upright
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene
from greenhouse_gym.shapes import RowShapes, extract_shapes

STATIONS = 50
ARM = "ur5e"  # its start is upright, as the paper's
SETTINGS = ReconstructionSettings()
WHOLE_ROW = Viewpoint((-2.8, -1.3, 1.9), (0.35, 0.2, 1.0), 45.0)
PAPER = {
    "stations": "50",
    "points of the row": "295,490",
    "time for a mesh of 295,490 points": "over an hour",
    "its faces": "398,571",
    "its faces after decimation": "143,422",
    "points simplified to 10,000": "10,346",
    "faces of their mesh": "17,967",
    "goal configurations": "60",
}
REGISTRATION = ("3-two-images", "4-background-removed", "5-silhouettes", "6-icp")
"""Names of the figures that `registration_pictures` draws."""

Numbers = dict[str, Any]


def main() -> None:
    """Make all figures and all numbers."""
    command = parser(__doc__)
    command.add_argument("--seed", type=int, default=204, help="of the row and of the stations")
    command.add_argument("--recording", type=Path, help="folder of a recording to take instead of rendering one")
    command.add_argument("--out", type=Path, default=RESULTS / "paper_figures", help="folder for the pictures")
    arguments = command.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recording = open_recording(arguments.recording or rendered(arguments.seed, Path(folder) / "recording"))
        photographs(recording, arguments.out)
        draw_setup(recording.rig, arguments.out / "2-setup.png")
        row, numbers = reconstruction(recording, arguments.out)
        numbers |= meshes(row)
        shapes = extract_shapes(row.points, row.colors, row.normals)
        numbers |= simulation(recording, row, shapes, arguments.out)
    print(compared(numbers))
    results = {"recording": recording.name, "arm": ARM, "here": numbers, "paper": PAPER}
    write_results(arguments.out.with_suffix(".json"), results)


def rendered(seed: int, folder: Path) -> Path:
    """Photograph a row of 5 m from 50 stations."""
    recording = simulate_recording(grow_row(seed, 5.0), seed, stations=STATIONS)
    with progress("stations rendered", len(recording)) as done:
        return write_recording(recording, folder, lambda i: done(i + 1))


# -- figures 1 to 7: the 3D map ---------------------------------------------------------------------------------------


def photographs(recording: Recording, out: Path) -> None:
    """Figures 1 and 3 to 6: photographs, foreground, silhouettes at the best shift, clouds before and after ICP."""
    first = len(recording) // 2
    save_jpeg(upright(recording[first].frames[recording.rig.reference].color), out / "1-greenhouse.jpg")
    calibration = Calibration(recording.rig)
    with tempfile.TemporaryDirectory() as folder:
        drawn = registration_pictures(recording, first, first + 1, calibration, SETTINGS, Path(folder))
        for name, path in zip(REGISTRATION, drawn, strict=True):
            save_jpeg(cv2.imread(str(path))[..., ::-1], out / f"{name}.jpg")


def draw_setup(rig: Rig, path: Path) -> None:
    """Figure 2: the cameras on their beam and their fields of view from above; up is into the plants."""
    figure = Figure(figsize=(9.0, 7.3), layout="constrained")
    axes = figure.add_subplot()
    for (name, camera), color in zip(rig.cameras.items(), ("#3b6fb6", "#2c8a4b", "#c0662b"), strict=True):
        k, rig_from_camera = camera.intrinsics, camera.rig_from_camera

        def above(points: Sequence[Sequence[float]], view: Any = rig_from_camera) -> Any:
            """Return points (n, 3) of the camera frame in the drawing (2, n)."""
            x, y, _ = transform(view, points).T
            return np.array([-y, x])

        low, high = (0.7 * (v - k.cy) / k.fy for v in (0, k.height))
        axes.fill(*above([[0, 0, 0], [0, low, 0.7], [0, high, 0.7]]), color=color, alpha=0.18)
        axes.plot(*above([[0, 0, 0], [0, 0, 0.7]]), color=color, linestyle="--", linewidth=1)
        axes.fill(*above([[0, -0.045, -0.025], [0, 0.045, -0.025], [0, 0.045, 0], [0, -0.045, 0]]), "#333333", zorder=3)
        axes.text(*above([[0, 0, -0.075]])[:, 0], name, ha="center", va="center", color=color)
    beam = np.array([camera.rig_from_camera[:2, 3] for camera in rig.cameras.values()])
    axes.plot(-beam[:, 1], beam[:, 0] - 0.012, color="#999999", linewidth=6, zorder=0)
    axes.plot([-beam[0, 1]] * 2, [0, 0.3], color="#555555", linestyle=":", linewidth=1)
    axes.axhspan(0.42, 0.58, color="#7fae5c", alpha=0.25, linewidth=0)
    axes.text(-0.61, 0.5, "nearest plants,\nabout 50 cm away", color="#456b28", va="center")
    axes.axhline(SETTINGS.foreground, color="#b03a2e", linewidth=1)
    axes.text(-0.61, SETTINGS.foreground + 0.01, "60 cm: what lies beyond is removed", color="#b03a2e", va="bottom")
    spacing = {"arrowstyle": "<->", "color": "#555555"}
    for left in (-0.25, 0.0):
        axes.annotate("", (left, -0.13), (left + 0.25, -0.13), arrowprops=spacing)
        axes.text(left + 0.125, -0.14, "25 cm", ha="center", va="top", color="#555555")
    axes.annotate("", (-0.6, -0.1), (-0.4, -0.1), arrowprops={"arrowstyle": "->", "linewidth": 2})
    axes.text(-0.5, -0.09, "10 cm per station", ha="center", va="bottom")
    axes.text(0.215, 0.22, "25°", ha="center")
    axes.set(xlim=(-0.62, 0.62), ylim=(-0.2, 0.8), aspect="equal")
    axes.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_figure(path, dpi=100)


def reconstruction(recording: Recording, out: Path) -> tuple[RowCloud, Numbers]:
    """Figure 7: the row in one color per station, before and after outlier removal."""
    started = time.perf_counter()
    with progress("stations registered", len(recording)) as done:
        stations = register_stations(recording, SETTINGS, lambda i: done(i + 1))
    merged, outlier = merge_segment(stations, 0, SETTINGS)
    row = remove_outliers(merged, outlier)
    seconds = time.perf_counter() - started
    mesh = triangulate(simplify_points(row, 10_000))
    with tempfile.TemporaryDirectory() as folder:
        before, after = (cv2.imread(str(path)) for path in row_pictures(merged, row, mesh, Path(folder))[:2])
    save_jpeg(np.concatenate([before, after])[..., ::-1], out / "7-outlier-removal.jpg")
    count = int(row.registered.sum())
    return row, {"stations": len(recording), "registered": count, "points": len(row), "reconstruction_s": seconds}


# -- figures 8 to 10: the simulation ----------------------------------------------------------------------------------


def meshes(row: RowCloud) -> Numbers:
    """Triangulate the whole cloud, decimate the mesh, and triangulate the simplified cloud."""
    paper_sized = simplify_points(row, 295_490)
    numbers: Numbers = {"mesh_points": len(paper_sized)}
    for name, faces in (("mesh", None), ("decimated", 18_000)):
        wall, processor = time.perf_counter(), time.process_time()
        mesh = triangulate(paper_sized, faces=faces)
        numbers |= {
            f"{name}_faces": len(mesh.triangles),
            f"{name}_s": time.perf_counter() - wall,
            f"{name}_processor_s": time.process_time() - processor,
        }
    simplified = simplify_points(row, 10_000)
    return numbers | {"simplified_points": len(simplified), "final_faces": len(triangulate(simplified).triangles)}


def simulation(recording: Recording, row: RowCloud, shapes: RowShapes, out: Path) -> Numbers:
    """Figures 8 to 10: the arm before the whole row, at its start, and at a tomato with the path of its tip."""
    length = float(np.ptp(row.world_from_station[row.registered][:, 1, 3]))  # one arm placement
    whole = BuildSettings(spacing=length, width=8.0, reach=5.0, max_shapes=10_000, robot=ARM)
    compiled = compile_scene(cut_scenes(row, shapes, recording, None, whole)[0], ARM)
    data = mujoco.MjData(compiled.model)
    data.qpos[:] = get_robot(ARM).start
    mujoco.mj_forward(compiled.model, data)
    save_jpeg(render_scene(compiled.model, data, WHOLE_ROW, 1400, 640), out / "8-simulation-environment.jpg")
    scene = cut_scenes(row, shapes, recording, None, BuildSettings(spacing=length, robot=ARM))[0]
    target, goals, found = planned(scene)
    assert found.path is not None
    for name, path in (("9-initial-position", found.path[:1]), ("10-final-position", resample(found.path, 0.03))):
        save_jpeg(picture_of_path(scene, ARM, target, path, width=960, height=720), out / f"{name}.jpg")
    return {
        "shapes": len(compiled.scene.obstacles),
        "scene_shapes": len(scene.obstacles),
        "goal_configurations": goals,
        "goal_s": found.goal_time,
        "planner": found.planner,
        "planning_s": found.planning_time,
    }


def planned(scene: Scene) -> tuple[int, int, PlanResult]:
    """Return target, number of goal configurations and plan for the ripest tomato whose reach is visible."""
    compiled = compile_scene(scene, ARM)
    ripest_first = np.argsort([-(tomato.ripeness or 0.0) for tomato in scene.tomatoes], kind="stable")
    for target in map(int, ripest_first):
        started = time.perf_counter()
        goals = goal_configurations(scene, target, ARM)
        goal_time = time.perf_counter() - started
        found = replace(plan(scene, target, ARM, goals=goals), goal_time=goal_time)
        if found.path is not None and tip_is_visible(compiled, found.path[-1]):
            return target, len(goals.configurations), found
    raise SystemExit(f"{scene.name}: the arm's tool is hidden at every tomato")


def tip_is_visible(compiled: CompiledScene, configuration: Array) -> bool:
    """Return whether nothing occludes the arm's tool from the camera of the pictures."""
    data = mujoco.MjData(compiled.model)
    data.qpos[:] = configuration
    mujoco.mj_forward(compiled.model, data)
    eye = np.array(default_camera(compiled.scene.placement).position)
    along = data.site_xpos[compiled.tip_site] - 0.1 * data.site_xmat[compiled.tip_site].reshape(3, 3)[:, 2] - eye
    far = float(np.linalg.norm(along))
    return bool(mujoco.mj_ray(compiled.model, data, eye, along / far, None, 1, -1, None) > far - 0.03)


# -- output -----------------------------------------------------------------------------------------------------------


def compared(numbers: Numbers) -> str:
    """Return the paper's numbers and ours as a Markdown table."""
    n = numbers
    here = {
        "stations": f"{n['registered']} of {n['stations']} registered",
        "points of the row": f"{n['points']:,}",
        "time for a mesh of 295,490 points": f"{n['mesh_s']:.1f} s ({n['mesh_points']:,} points)",
        "its faces": f"{n['mesh_faces']:,}",
        "its faces after decimation": f"{n['decimated_faces']:,} ({n['decimated_s']:.1f} s, mesh included)",
        "points simplified to 10,000": f"{n['simplified_points']:,}",
        "faces of their mesh": f"{n['final_faces']:,}",
        "goal configurations": f"{n['goal_configurations']} ({n['goal_s']:.2f} s)",
    }
    return table(("figure", "paper", "here"), [(name, PAPER[name], ours) for name, ours in here.items()])


def save_jpeg(image: Image, path: Path) -> None:
    """Write an image (height, width, 3) RGB as a JPEG file."""
    _, buffer = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    write_atomically(path, buffer.tobytes())


if __name__ == "__main__":
    main()
