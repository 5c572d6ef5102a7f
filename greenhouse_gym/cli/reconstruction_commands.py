"""Commands from recordings and clouds to banks: reconstruct, shapes, build, build-shipped."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from greenhouse_gym.cli.options import (
    Address,
    Backend,
    Format,
    Out,
    SettingsFile,
    Workers,
    executor_of,
    print_settings,
    set_option,
)
from greenhouse_gym.common.progress import progress, say

if TYPE_CHECKING:
    from greenhouse_gym.capture import Recording
    from greenhouse_gym.reconstruction import ReconstructionSettings
import json
import warnings

if TYPE_CHECKING:
    from greenhouse_gym.build.scans import Scan, ScannedRow


Units = Annotated[
    str | None,
    typer.Option(help="Unit: m, cm, mm, in, ft, us-ft or a number of metres; by default the file's, or estimated."),
]
Up = Annotated[
    str | None, typer.Option(help="Up direction of the cloud: x, y, z, -x, -y, -z or a vector such as 0,0.1,1.")
]
SeenFrom = Annotated[str | None, typer.Option(help="Position of the scanner in the cloud's frame, such as 0,0,1.2.")]
Floor = Annotated[float | None, typer.Option(help="Height of the floor, metres; estimated by default.")]


def shapes(
    cloud: Annotated[Path, typer.Argument(help="File of a cloud: ply, pcd, las, laz, e57, npy, npz, xyz or txt.")],
    out: Out,
    units: Units = None,
    up: Up = None,
    seen_from: SeenFrom = None,
    settings: SettingsFile = None,
    assignments: Annotated[list[str] | None, set_option("voxel=0.004")] = None,
    print_defaults: Annotated[bool, print_settings("greenhouse_gym.shapes:ShapeSettings")] = False,
) -> None:
    """Find tomatoes, stems and clutter in a cloud of another source, and print the assumptions made.

    Writes shapes.json (metres, z up), cloud.ply (the cloud in that frame) and report.json (the assumptions, and the
    transform of the file's points, times its unit, into that frame).
    """
    from greenhouse_gym.build.scans import extract_from_scan
    from greenhouse_gym.common.files import exclusive, write_atomically
    from greenhouse_gym.common.settings_files import resolve
    from greenhouse_gym.reconstruction.row_files import save_points
    from greenhouse_gym.scene import Shapes
    from greenhouse_gym.shapes import ShapeSettings, ShapeWarning

    resolved = resolve(ShapeSettings(), settings, assignments or ())
    opened = _opened(cloud, units, up, seen_from)
    say(f"searching shapes in {len(opened.cloud)} points")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ShapeWarning)  # printed below
        with progress("searching shapes"):
            scan, found = extract_from_scan(opened, resolved)
    for note in (*scan.notes[len(opened.notes) :], *found.warnings):
        say(note)
    notes = [*scan.notes, *found.warnings]
    parts = Shapes(tomatoes=found.tomatoes, stems=found.stems, clutter=found.clutter)
    report = {"unit": scan.unit, "row_from_file": scan.row_from_file.tolist(), "notes": notes}
    with exclusive(out):
        write_atomically(out / "shapes.json", parts.model_dump_json(indent=1) + "\n")
        write_atomically(out / "report.json", json.dumps(report | {"confidence": found.confidence}, indent=1) + "\n")
        save_points(scan.cloud, out / "cloud.ply")
    say(f"{len(found.tomatoes)} tomatoes, {len(found.stems)} pieces of stem, {len(found.clutter)} boxes: {out}")


def scanned_row_of(
    cloud: Path, units: str | None, up: str | None, seen_from: str | None, floor: float | None
) -> ScannedRow:
    """Return a cloud as a row to build a bank from, given the texts of the options."""
    from greenhouse_gym.build.scans import scanned_row

    return scanned_row(_opened(cloud, units, up, seen_from), floor)


def _opened(cloud: Path, units: str | None, up: str | None, seen_from: str | None) -> Scan:
    from greenhouse_gym.build.scans import open_scan

    direction = _numbers("--up", up) if up and "," in up else up
    if cloud.is_file():
        say(f"reading {cloud}, {cloud.stat().st_size / 1e6:.0f} MB")
    with progress("reading the cloud"):
        scan = open_scan(cloud, _number(units), direction, _numbers("--seen-from", seen_from))
    for note in scan.notes:
        say(note)
    return scan


def _number(text: str | None) -> str | float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return text


def _numbers(option: str, text: str | None) -> list[float] | None:
    from greenhouse_gym.errors import InvalidValueError

    try:
        return None if text is None else [float(part) for part in text.split(",")]
    except ValueError as error:
        raise InvalidValueError(f"{option}: expected three numbers such as 0,0,1.2, got {text!r}") from error


def reconstruct(
    recording: Annotated[Path, typer.Argument(help="A recording of any known format: a folder, or a bag.")],
    out: Out,
    method: Annotated[
        str, typer.Option(help="Meshing method: ball_pivoting, poisson or alpha_shape.")
    ] = "ball_pivoting",
    points: Annotated[int, typer.Option(min=4, help="Points of the simplified cloud, which is meshed.")] = 10_000,
    faces: Annotated[int, typer.Option(min=1, help="Maximum number of faces of the mesh.")] = 18_000,
    format: Format = None,
    poses: Annotated[
        str | None, typer.Option(help="Poses of the stations: estimate, given (trust the recording) or refine.")
    ] = None,
    settings: SettingsFile = None,
    assignments: Annotated[list[str] | None, set_option("voxel=0.004")] = None,
    print_defaults: Annotated[bool, print_settings("greenhouse_gym.reconstruction:ReconstructionSettings")] = False,
) -> None:
    """Reconstruct a recording as a cloud and a mesh, with a report; resumes an interrupted run.

    Finished stations are kept in the folder "registration" next to the results until all results are written.
    """
    from greenhouse_gym.capture import open_recording
    from greenhouse_gym.common.files import exclusive
    from greenhouse_gym.common.settings_files import resolve
    from greenhouse_gym.errors import require_choice
    from greenhouse_gym.reconstruction import METHODS, settings_for

    require_choice("meshing method", method, METHODS)
    opened = open_recording(recording, format)
    fitting = settings_for(opened)
    _print_differences(fitting)
    resolved = resolve(fitting, settings, [*(assignments or ()), *([f"poses={poses}"] if poses else [])])
    with exclusive(out):
        _reconstruct(opened, resolved, out, method, points, faces)


def _reconstruct(
    opened: Recording, settings: ReconstructionSettings, out: Path, method: str, points: int, faces: int
) -> None:
    from greenhouse_gym.common.files import remove_folder
    from greenhouse_gym.errors import FileFormatError, ReconstructionError
    from greenhouse_gym.reconstruction import simplify_points, triangulate
    from greenhouse_gym.reconstruction.station_journal import StationJournal, station_file
    from greenhouse_gym.reconstruction.station_registration import register_stations
    from greenhouse_gym.reporting.report_page import write_results

    work = out / "registration"
    if work.exists() and any(work.iterdir()) and not station_file(work, 0).exists():
        raise FileFormatError(work, "is not the work folder of a reconstruction; choose another --out or remove it")
    finished = len(StationJournal.open(work, opened, settings).entries)
    if finished:
        say(f"resuming after station {finished - 1}")
    try:
        with progress("stations", len(opened)) as on_progress:
            stations = register_stations(opened, settings, lambda i: on_progress(i + 1), work)
        with progress("merging, meshing, drawing"):
            rows, mesh = write_results(
                stations, opened, settings, lambda row: triangulate(simplify_points(row, points), method, faces),
                out, work=work / "results",
            )  # fmt: skip
        remove_folder(work)
    except KeyboardInterrupt:
        finished = len(StationJournal.open(work, opened, settings).entries)
        kept = f"{finished} of {len(opened)} stations are kept in {work}"
        say(f"interrupted: {kept}; repeat the command to resume")
        raise typer.Exit(130) from None
    except ReconstructionError:
        remove_folder(work)
        raise
    for station in rows[0].report.stations:
        if station.reason:
            fate = "begins a new segment" if station.registered else "skipped"
            say(f"station {station.station} {fate}: {station.reason}")
    for warning in rows[0].report.warnings:
        say(f"warning: {warning}", style="red")
    registered, cloud = sum(row.registered.sum() for row in rows), sum(map(len, rows))
    say(f"{registered} of {len(opened)} stations, {cloud} points, {len(mesh.triangles)} faces: {out / 'report.html'}")


def _print_differences(settings: ReconstructionSettings) -> None:
    """Print the settings that differ from the defaults because of the recording."""
    from dataclasses import asdict

    from greenhouse_gym.reconstruction import ReconstructionSettings

    usual = asdict(ReconstructionSettings())
    for name, value in asdict(settings).items():
        if value != usual[name]:
            say(f"from the recording: {name} = {value} instead of {usual[name]}; --set {name}=... overrides it")


def build(
    recordings: Annotated[
        list[Path], typer.Argument(help="Folders of recordings, or with --cloud files of clouds, one per row.")
    ],
    out: Out,
    name: Annotated[str, typer.Option(help="The bank's name; the folder's name by default.")] = "",
    format: Format = None,
    cloud: Annotated[bool, typer.Option("--cloud", help="The arguments are files of clouds, not recordings.")] = False,
    units: Units = None,
    up: Up = None,
    seen_from: SeenFrom = None,
    floor: Floor = None,
    settings: SettingsFile = None,
    assignments: Annotated[list[str] | None, set_option("shapes.voxel=0.004")] = None,
    print_defaults: Annotated[bool, print_settings("greenhouse_gym.build.scenes:BuildSettings")] = False,
    backend: Backend = None,
    workers: Workers = None,
    address: Address = "local",
) -> None:
    """Build a bank of scenes from recordings; resumes an interrupted build.

    Settings of the reconstruction default to those that the recordings' protocol needs.
    """
    from greenhouse_gym.common.extras import require_extras

    require_extras("reconstruct", "plan")
    from greenhouse_gym.build import build_bank
    from greenhouse_gym.build.scenes import BuildSettings
    from greenhouse_gym.capture import open_recording
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.common.settings_files import as_toml, resolve
    from greenhouse_gym.reconstruction import settings_for

    opened = [
        scanned_row_of(path, units, up, seen_from, floor) if cloud else open_recording(path, format)
        for path in recordings
    ]
    needed = {settings_for(recording) for recording in opened}
    resolved = resolve(
        BuildSettings(reconstruction=needed.pop() if len(needed) == 1 else None), settings, assignments or ()
    )
    try:
        with executor_of(backend, workers, address, len(opened)) as executor, progress("building"):
            bank = build_bank(opened, out, name or out.resolve().name, settings=resolved, executor=executor)
    except KeyboardInterrupt:
        say(f"interrupted: finished parts are kept in {out}; repeat the command to resume")
        raise typer.Exit(130) from None
    write_atomically(out / "settings.toml", as_toml(resolved))
    say(f"{len(bank)} scenes in {out}")


def build_shipped(
    out: Out = Path("scenes"),
    parts: Annotated[Path, typer.Option(help="Folder for the bank of each recording.")] = Path("runs/shipped"),
    processes: Annotated[
        int | None, typer.Option(min=1, help="Recordings built at once; one per core by default.")
    ] = None,
    finished_only: Annotated[bool, typer.Option("--finished-only", help="Only join the finished parts.")] = False,
) -> None:
    """Build the shipped banks, default and mini, from simulated recordings; resumes an interrupted build."""
    from greenhouse_gym.build.shipped import build_shipped_banks, join_parts
    from greenhouse_gym.common import executors as parallel

    if finished_only:
        banks = join_parts(parts, out)
    else:
        with parallel.processes(processes) as executor, progress("building"):
            banks = build_shipped_banks(out, parts, executor)
    for bank in banks:
        say(f"{bank.manifest.name}: {len(bank)} scenes in {bank.path}")
