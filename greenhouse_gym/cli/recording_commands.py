"""Commands that make recordings or prepare for them: simulate, record, import, calibrate, formats."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from greenhouse_gym.cli.options import Format, Out, RigFile, whole_pair
from greenhouse_gym.common.progress import progress, say

if TYPE_CHECKING:
    from greenhouse_gym.capture import Recording
import sys
from collections.abc import Iterable, Iterator
from queue import SimpleQueue
from threading import Thread
from typing import TYPE_CHECKING, TextIO

from greenhouse_gym.errors import InvalidValueError

if TYPE_CHECKING:
    from greenhouse_gym.capture import Station
    from greenhouse_gym.capture.recorder import RecordedStation


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder for the recording.")],
    seed: Annotated[int, typer.Option(help="Seed of the row, the tripod's path and the noise.")] = 1,
    length: Annotated[float, typer.Option(help="Length of the row in metres.")] = 2.0,
    week: Annotated[int, typer.Option(help="Growth week, 0 = first harvest.")] = 0,
    style: Annotated[str, typer.Option(help="Fruit style: cluster, beefsteak or cherry; Helios has more.")] = "cluster",
    source: Annotated[str, typer.Option(help="Generator of the plants: own or helios (extra plants).")] = "own",
    protocol: Annotated[
        str, typer.Option(help="Capture protocol: paper, upright, back, upright-back or two-passes.")
    ] = "paper",
) -> None:
    """Grow a row and record it with a simulated rig."""
    from greenhouse_gym.capture import simulate_protocol, write_recording
    from greenhouse_gym.crops import grow_row

    recording = simulate_protocol(grow_row(seed, length, week, style, source=source), seed, protocol)
    with progress("stations", len(recording)) as on_progress:
        write_recording(recording, out, lambda i: on_progress(i + 1))
    say(f"{len(recording)} stations in {out}")


def formats() -> None:
    """List the readable formats of recordings, including those of installed packages."""
    from greenhouse_gym.capture import recording_formats

    for known in recording_formats().values():
        say(f"{known.name}: {known.description}")


def import_(
    source: Annotated[Path, typer.Argument(help="A bag, or a folder in one of the known formats.")],
    out: Out,
    rig: RigFile = None,
    format: Format = None,
    step: Annotated[
        float, typer.Option(help="Metres between the stations of a video; 0 takes every frame.", min=0.0)
    ] = 0.10,
) -> None:
    """Convert the data of other cameras into a recording, with a picture, a report and a verdict.

    A continuous video gives one station about every 10 cm, the sharpest frame nearby. Writes the recording with
    import.json (figures and verdict) and import.png (stations side by side).
    """
    from greenhouse_gym.capture import open_recording, write_recording
    from greenhouse_gym.capture.formats.own import INDEX
    from greenhouse_gym.capture.inspection import inspect_recording
    from greenhouse_gym.capture.station_selection import choose_stations, select_stations
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.errors import FileFormatError, GreenhouseError
    from greenhouse_gym.rendering.picture_files import write_picture
    from greenhouse_gym.reporting.pictures import contact_sheet

    report, picture = out / "import.json", out / "import.png"
    if (out / INDEX).exists() and not (report.exists() and not picture.exists()):  # else it was interrupted
        raise FileFormatError(out / INDEX, "already holds a recording; choose another folder or remove it")
    opened = _on_rig(open_recording(source, format), rig)
    notes = list(opened.notes)
    if step > 0 and len(opened) > 2:
        with progress("frames", len(opened)) as on_progress:
            picked = choose_stations(opened, step, lambda i: on_progress(i + 1))
        notes.append(f"{len(picked.frames)} of {len(opened)} frames taken over {picked.path[-1]:.2f} m")
        if picked.lost:
            notes.append(f"the motion is unknown at {len(picked.lost)} frames and was assumed to continue")
        if picked.unreadable:
            notes.append(f"{len(picked.unreadable)} frames are unreadable and were left out")
        opened = select_stations(opened, picked.frames)
    content = {"source": str(source), "notes": notes}
    write_atomically(report, json.dumps(content) + "\n")
    (out / INDEX).unlink(missing_ok=True)
    try:
        with progress("stations", len(opened)) as on_progress:
            write_recording(replace(opened, notes=()), out, lambda i: on_progress(i + 1))
    except GreenhouseError:
        report.unlink()  # nothing could be written: the folder may be used again
        raise
    found = inspect_recording(open_recording(out))
    write_atomically(report, json.dumps({**content, **asdict(found)}, indent=1) + "\n")
    write_picture(contact_sheet(open_recording(out)), picture)
    for line in (*notes, *found.verdict):
        say(line)
    say(f"{len(opened)} stations in {out}")


def calibrate(
    source: Annotated[Path, typer.Argument(help="A recording of a board, or with --no-board of plants.")],
    out: Annotated[Path, typer.Option("--out", help="Rig file to write.")],
    rig: Annotated[
        Path | None,
        typer.Option("--rig", help="Rig file with the reference camera's pose; without a board, rough poses of all."),
    ] = None,
    format: Format = None,
    board: Annotated[bool, typer.Option("--board/--no-board", help="Calibrate from a ChArUco board.")] = True,
    squares: Annotated[str, typer.Option(help="Columns and rows of squares on the board, such as 8x6.")] = "8x6",
    square: Annotated[float, typer.Option(help="Side of a square, metres.")] = 0.030,
    marker: Annotated[float, typer.Option(help="Side of a marker, metres.")] = 0.022,
    dictionary: Annotated[str, typer.Option(help="OpenCV's dictionary of the markers.")] = "DICT_5X5_100",
) -> None:
    """Estimate the poses of a rig's cameras and their depth errors, and write a rig file.

    The reference camera keeps its pose from the given rig file.
    """
    import numpy as np

    from greenhouse_gym.capture import open_recording
    from greenhouse_gym.capture.boards import Board, calibrate_from_boards
    from greenhouse_gym.capture.rig_file import save_mounting
    from greenhouse_gym.errors import InvalidValueError
    from greenhouse_gym.reconstruction.calibration import calibrate_from_overlap

    opened, new = _on_nominal_rig(open_recording(source, format), rig)
    if new and not board:
        raise InvalidValueError(
            f"{rig} has no pose of {', '.join(new)}: without a board, all are needed, to a few degrees and cm"
        )
    if board:
        across, down = whole_pair("--squares", squares, "8x6")
        with progress("searching the board"):
            found = calibrate_from_boards(opened, opened.rig, Board(across, down, square, marker, dictionary))
        mounting, turned, shifted = found.mounting, found.turned, found.shifted
        for name, pixels in found.residual.items():
            say(f"{name}: board seen {found.moments[name]} times, residual of corners {pixels:.2f} px")
    else:
        with progress("aligning the surfaces"):
            mounting, turned, shifted, gap = calibrate_from_overlap(opened)
        say(f"median distance between the surfaces that two cameras see: {1e3 * gap:.2f} mm")
    for name in mounting.rig_from_camera:
        depth = mounting.depth_error.get(name, 0.0)
        if name in new:
            say(f"{name}: new in the rig file; depth {100 * depth:+.2f} %")
            continue
        text = f"{name}: turned by {np.degrees(turned[name]):.2f} degrees and shifted by {1e3 * shifted[name]:.1f} mm"
        say(f"{text} relative to the previous rig; depth {100 * depth:+.2f} %")
        if turned[name] > 0.035 or shifted[name] > 0.02:
            say(f"{name} has moved: was it knocked, or does the rig file describe another rig?", style="red")
    save_mounting(mounting, out)
    say(f"written to {out}")


def _on_nominal_rig(opened: Recording, rig: Path | None) -> tuple[Recording, tuple[str, ...]]:
    """Return the recording with cameras posed by a rig file, and the cameras it lacks, posed like its reference."""
    from greenhouse_gym.capture.rig_file import load_mounting, with_mounting
    from greenhouse_gym.errors import InvalidValueError

    if rig is None:
        if len(opened.rig.cameras) > 1 and len(_poses(opened)) == 1:
            names = ", ".join(opened.rig.cameras)
            raise InvalidValueError(f"give --rig, a rig file with the pose of one of the cameras {names}")
        return opened, ()
    mounting = load_mounting(rig)
    new = tuple(name for name in opened.rig.cameras if name not in mounting.rig_from_camera)
    poses = dict(mounting.rig_from_camera) | dict.fromkeys(new, mounting.rig_from_camera[mounting.reference])
    return with_mounting(opened, replace(mounting, rig_from_camera=poses)), new


def _poses(opened: Recording) -> set[bytes]:
    return {camera.rig_from_camera.tobytes() for camera in opened.rig.cameras.values()}


def _on_rig(opened: Recording, rig: Path | None) -> Recording:
    from greenhouse_gym.capture.rig_file import load_mounting, with_mounting
    from greenhouse_gym.errors import InvalidValueError

    if rig is not None:
        return with_mounting(opened, load_mounting(rig))
    if len(_poses(opened)) < len(opened.rig.cameras):
        names = ", ".join(opened.rig.cameras)
        raise InvalidValueError(
            f"the poses of the cameras {names} are unknown: give --rig, a file that calibrate wrote"
        )
    return opened


def record(
    out: Annotated[Path, typer.Option("--out", help="Folder for the recording.")],
    rig: RigFile = None,
    camera: Annotated[
        list[str] | None,
        typer.Option("--camera", help="NAME=SERIAL of a camera, once for each; all connected cameras by default."),
    ] = None,
    step: Annotated[
        float, typer.Option(help="Metres between stations; 0 takes one only when Enter is pressed.", min=0.0)
    ] = 0.10,
    playback: Annotated[
        list[Path] | None, typer.Option(help="A RealSense recording to play back, once for each camera.")
    ] = None,
) -> None:
    """Record stations with RealSense cameras: one about every 10 cm of motion, and one whenever Enter is pressed.

    Each station is written and checked at once; q and Enter, or Ctrl-C, ends. preview.png in the folder is updated
    continuously: points beyond the plants are dark in it.
    """
    from greenhouse_gym.capture import open_recording
    from greenhouse_gym.capture.formats.own import INDEX
    from greenhouse_gym.capture.inspection import inspect_recording
    from greenhouse_gym.capture.realsense import realsense_cameras
    from greenhouse_gym.capture.recorder import PREVIEW
    from greenhouse_gym.capture.recorder import record as write_stations
    from greenhouse_gym.capture.rig_file import load_mounting, mounted_rig

    keys = Keys(sys.stdin)
    with realsense_cameras(_serials(camera or ()), playback or ()) as live:
        cameras = live.rig if rig is None else mounted_rig(live.rig, load_mounting(rig))
        say(f"cameras {', '.join(cameras.cameras)}; Enter takes a station, q and Enter ends; preview: {out / PREVIEW}")
        try:
            write_stations(keys.until_end(live.moments), cameras, out, step, keys.pressed, _report)
        except KeyboardInterrupt:
            say("interrupted; the recorded stations are kept")
    if not (out / INDEX).exists():
        raise InvalidValueError(f"no station was recorded in {out}")
    recording = open_recording(out)
    for line in inspect_recording(recording).verdict:
        say(line)
    say(f"{len(recording)} stations in {out}")


class Keys:
    """Lines typed during a recording: an empty line requests a station, q ends."""

    def __init__(self, typed: TextIO):
        self._lines: SimpleQueue[str] = SimpleQueue()
        self._requested = 0
        Thread(target=self._listen, args=(typed,), daemon=True).start()

    def _listen(self, typed: TextIO) -> None:
        for line in typed:
            self._lines.put(line.strip())

    def until_end(self, moments: Iterable[Station]) -> Iterator[Station]:
        """Yield moments until q is typed."""
        for moment in moments:
            while not self._lines.empty():
                if self._lines.get().lower() == "q":
                    return
                self._requested += 1
            yield moment

    def pressed(self) -> bool:
        """Return whether a station was requested; each press counts once."""
        pressed = self._requested > 0
        self._requested = max(0, self._requested - 1)
        return pressed


def _report(taken: RecordedStation) -> None:
    moved = "" if taken.moved is None else f", {100 * taken.moved:.0f} cm on"
    say(f"station {taken.number}{moved}")
    for fault in taken.faults:
        say(f"  {fault}", style="red")


def _serials(texts: Iterable[str]) -> dict[str, str] | None:
    pairs = [text.partition("=") for text in texts]
    for name, _, number in pairs:
        if not name or not number:
            raise InvalidValueError(f"--camera: expected NAME=SERIAL, got {name!r}")
    return {name: number for name, _, number in pairs} or None
