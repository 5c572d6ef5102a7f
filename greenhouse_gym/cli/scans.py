"""Commands on clouds that were not recorded with this package's rig."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from greenhouse_gym.cli.settings import Assignments, SettingsFile, shown
from greenhouse_gym.common.progress import say

if TYPE_CHECKING:
    from greenhouse_gym.build.scans import Scan, ScannedRow

Units = Annotated[str | None, typer.Option(help="Unit of the cloud: m, cm, mm or a number of metres; else guessed.")]
Up = Annotated[
    str | None, typer.Option(help="What is up in the cloud: x, y, z, -x, -y, -z or a vector such as 0,0.1,1.")
]
SeenFrom = Annotated[str | None, typer.Option(help="Where the cloud was seen from, in its own frame, such as 0,0,1.2.")]
Floor = Annotated[float | None, typer.Option(help="Height of the floor, metres; guessed when left out.")]


def _shape_settings() -> object:
    from greenhouse_gym.shapes import ShapeSettings

    return ShapeSettings()


def shapes(
    cloud: Annotated[Path, typer.Argument(help="File of a cloud: ply, pcd, las, laz, e57, npy, npz, xyz or txt.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the results.")],
    units: Units = None,
    up: Up = None,
    seen_from: SeenFrom = None,
    settings: SettingsFile = None,
    assignments: Assignments = None,
    print_settings: Annotated[bool, shown(_shape_settings)] = False,
) -> None:
    """Find tomatoes, stems and clutter in a cloud that comes from elsewhere; what had to be assumed is said.

    Writes shapes.json (metres, z up), cloud.ply (the cloud in that frame) and report.json (what was assumed, and what
    brings the file's points, times its unit, into that frame).
    """
    from greenhouse_gym.build.scans import extract_from_scan
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.common.settings_files import resolve
    from greenhouse_gym.reconstruction.surface import save_points
    from greenhouse_gym.scene import Shapes
    from greenhouse_gym.shapes import ShapeSettings, ShapeWarning

    resolved = resolve(ShapeSettings(), settings, assignments or ())
    opened = _opened(cloud, units, up, seen_from)
    say(f"looking for shapes among {len(opened.cloud)} points")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ShapeWarning)  # they are told below
        scan, found = extract_from_scan(opened, resolved)
    for note in (*scan.notes[len(opened.notes) :], *found.warnings):
        say(note)
    notes = [*scan.notes, *found.warnings]
    parts = Shapes(tomatoes=found.tomatoes, stems=found.stems, clutter=found.clutter)
    write_atomically(out / "shapes.json", parts.model_dump_json(indent=1) + "\n")
    report = {"unit": scan.unit, "row_from_file": scan.row_from_file.tolist(), "notes": notes}
    write_atomically(out / "report.json", json.dumps(report | {"confidence": found.confidence}, indent=1) + "\n")
    save_points(scan.cloud, out / "cloud.ply")
    say(f"{len(found.tomatoes)} tomatoes, {len(found.stems)} pieces of stem, {len(found.clutter)} boxes: {out}")


def scanned(cloud: Path, units: str | None, up: str | None, seen_from: str | None, floor: float | None) -> ScannedRow:
    """A cloud as a row to build a bank of, from the texts of the options."""
    from greenhouse_gym.build.scans import scanned_row

    return scanned_row(_opened(cloud, units, up, seen_from), floor)


def _opened(cloud: Path, units: str | None, up: str | None, seen_from: str | None) -> Scan:
    from greenhouse_gym.build.scans import open_scan

    told = (_number(units), _numbers("--up", up) if up and "," in up else up, _numbers("--seen-from", seen_from))
    if cloud.is_file():
        say(f"reading {cloud}, {cloud.stat().st_size / 1e6:.0f} MB")
    scan = open_scan(cloud, *told)
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
