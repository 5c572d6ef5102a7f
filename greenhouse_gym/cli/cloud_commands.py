"""The command that finds shapes in clouds of other origin, and the options of such clouds."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from greenhouse_gym.cli.options import Out, SettingsFile, print_settings, set_option
from greenhouse_gym.common.progress import progress, say

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
