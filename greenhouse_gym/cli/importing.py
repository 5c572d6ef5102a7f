"""Commands from a real rig to a recording: import, calibrate."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from greenhouse_gym.cli.sensing import Format
from greenhouse_gym.common.progress import progress, say

if TYPE_CHECKING:
    from greenhouse_gym.capture import Recording

RigFile = Annotated[
    Path | None, typer.Option("--rig", help="Where the cameras stand: a rig file that calibrate wrote.")
]


def import_(
    source: Annotated[Path, typer.Argument(help="A bag, or a folder in one of the known formats.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the recording.")],
    rig: RigFile = None,
    format: Format = None,
    step: Annotated[
        float, typer.Option(help="Metres from station to station of a video; 0 takes every frame.", min=0.0)
    ] = 0.10,
) -> None:
    """Turn what cameras recorded into a recording, with a picture, a report and a verdict.

    Of a continuous video a frame about every 10 cm becomes a station, the sharpest near it. Writes the recording, and
    in it import.json (figures and verdict) and import.png (stations side by side).
    """
    from greenhouse_gym.capture import open_recording, write_recording
    from greenhouse_gym.capture.formats.stations import choose_stations
    from greenhouse_gym.capture.formats.videos import chosen
    from greenhouse_gym.capture.images import encode_png
    from greenhouse_gym.capture.inspection import inspect_recording
    from greenhouse_gym.capture.recordings import INDEX
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.errors import FileFormatError
    from greenhouse_gym.reporting.overview import overview

    if (out / INDEX).exists():
        raise FileFormatError(out / INDEX, "already holds a recording; choose another folder or remove it")
    opened = _on_rig(open_recording(source, format), rig)
    notes = list(opened.notes)
    if step > 0 and len(opened) > 2:
        with progress("frames", len(opened)) as done:
            picked = choose_stations(opened, step, lambda i: done(i + 1))
        notes.append(f"{len(picked.frames)} of {len(opened)} frames taken over {picked.path[-1]:.2f} m")
        if picked.lost:
            notes.append(f"the motion could not be told at {len(picked.lost)} frames, and was taken as that before")
        if picked.unreadable:
            notes.append(f"{len(picked.unreadable)} frames cannot be read and were left out")
        opened = chosen(opened, picked.frames)
    with progress("stations", len(opened)) as done:
        write_recording(replace(opened, notes=()), out, lambda i: done(i + 1))
    found = inspect_recording(open_recording(out))
    report = {"source": str(source), "notes": notes, **asdict(found)}
    write_atomically(out / "import.json", json.dumps(report, indent=1) + "\n")
    write_atomically(out / "import.png", encode_png(overview(open_recording(out))))
    for line in (*notes, *found.verdict):
        say(line)
    say(f"{len(opened)} stations in {out}")


def calibrate(
    source: Annotated[Path, typer.Argument(help="A recording of a board, or, without one, of plants.")],
    out: Annotated[Path, typer.Option("--out", help="Rig file to write.")],
    rig: Annotated[
        Path | None,
        typer.Option("--rig", help="A rig file: where the reference camera stands; without a board, roughly all."),
    ] = None,
    format: Format = None,
    board: Annotated[bool, typer.Option("--board/--no-board", help="Whether a ChArUco board was shown.")] = True,
    squares: Annotated[str, typer.Option(help="Columns and rows of squares on the board, such as 8x6.")] = "8x6",
    square: Annotated[float, typer.Option(help="Side of a square, metres.")] = 0.030,
    marker: Annotated[float, typer.Option(help="Side of a marker, metres.")] = 0.022,
    dictionary: Annotated[str, typer.Option(help="OpenCV's dictionary of the markers.")] = "DICT_5X5_100",
) -> None:
    """Find out where the cameras of a rig stand to each other, and their depth errors, and write a rig file.

    Of the rig file that is given the place of the reference camera is kept.
    """
    from greenhouse_gym.capture import open_recording
    from greenhouse_gym.capture.boards import Board, calibrate_from_boards
    from greenhouse_gym.capture.rig_file import save_mounting
    from greenhouse_gym.errors import InvalidValueError
    from greenhouse_gym.reconstruction.overlap import calibrate_from_overlap

    opened, new = _on_nominal_rig(open_recording(source, format), rig)
    if new and not board:
        raise InvalidValueError(
            f"{rig} does not say where {', '.join(new)} stand: without a board, all are needed, to a few degrees and cm"
        )
    if board:
        across, _, down = squares.partition("x")
        if not across.isdecimal() or not down.isdecimal():
            raise InvalidValueError(f"--squares: expected columns and rows such as 8x6, got {squares!r}")
        told = calibrate_from_boards(opened, opened.rig, Board(int(across), int(down), square, marker, dictionary))
        mounting, turned, shifted = told.mounting, told.turned, told.shifted
        for name, pixels in told.residual.items():
            say(f"{name}: board seen {told.moments[name]} times, corners {pixels:.2f} px off")
    else:
        mounting, turned, shifted, gap = calibrate_from_overlap(opened)
        say(f"surfaces that two cameras see are {1e3 * gap:.2f} mm apart in the median")
    for name in mounting.rig_from_camera:
        depth = mounting.depth_error.get(name, 0.0)
        if name in new:
            say(f"{name}: not in the rig file before; depth {100 * depth:+.2f} %")
            continue
        text = f"{name}: turned by {turned[name] * 57.29578:.2f} degrees and shifted by {1e3 * shifted[name]:.1f} mm"
        say(f"{text} against the rig as it was; depth {100 * depth:+.2f} %")
        if turned[name] > 0.035 or shifted[name] > 0.02:
            say(f"{name} is not where it was: was it knocked, or is the rig file another rig's?", style="red")
    save_mounting(mounting, out)
    say(f"written to {out}")


def _on_nominal_rig(opened: Recording, rig: Path | None) -> tuple[Recording, tuple[str, ...]]:
    """The recording with its cameras where a rig file says; and those it does not name, put where its reference is."""
    from greenhouse_gym.capture.rig_file import load_mounting, mounted
    from greenhouse_gym.errors import InvalidValueError

    if rig is None:
        if len(opened.rig.cameras) > 1 and len(_places(opened)) == 1:
            names = ", ".join(opened.rig.cameras)
            raise InvalidValueError(f"give --rig, a file that says where one of the cameras {names} stands")
        return opened, ()
    told = load_mounting(rig)
    new = tuple(name for name in opened.rig.cameras if name not in told.rig_from_camera)
    places = dict(told.rig_from_camera) | dict.fromkeys(new, told.rig_from_camera[told.reference])
    return mounted(opened, replace(told, rig_from_camera=places)), new


def _places(opened: Recording) -> set[bytes]:
    return {camera.rig_from_camera.tobytes() for camera in opened.rig.cameras.values()}


def _on_rig(opened: Recording, rig: Path | None) -> Recording:
    from greenhouse_gym.capture.rig_file import load_mounting, mounted
    from greenhouse_gym.errors import InvalidValueError

    if rig is not None:
        return mounted(opened, load_mounting(rig))
    if len(_places(opened)) < len(opened.rig.cameras):
        names = ", ".join(opened.rig.cameras)
        raise InvalidValueError(
            f"where the cameras {names} stand is not known: give --rig, a file that calibrate wrote"
        )
    return opened
