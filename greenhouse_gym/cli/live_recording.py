"""The command that records with RealSense cameras."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import TYPE_CHECKING, Annotated, TextIO

import typer

from greenhouse_gym.cli.options import RigFile
from greenhouse_gym.common.progress import say
from greenhouse_gym.errors import InvalidValueError

if TYPE_CHECKING:
    from greenhouse_gym.capture import Station
    from greenhouse_gym.capture.recorder import RecordedStation


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
