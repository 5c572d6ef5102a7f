"""Recorder: selects stations from camera images, writes each at once and checks it.

The images come from any iterable of `Station`: RealSense cameras (`greenhouse_gym.capture.realsense`) or a recording
that is played back.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.formats.own import RecordingWriter
from greenhouse_gym.capture.image_files import encode_png
from greenhouse_gym.capture.inspection import plant_mask, station_faults
from greenhouse_gym.capture.rig import RgbdFrame, Rig, Station
from greenhouse_gym.capture.station_selection import Odometer, sharpness
from greenhouse_gym.common.files import write_atomically

PREVIEW = "preview.png"
"""Current view of the cameras, next to the recording, with everything beyond the plants darkened; updated meanwhile."""

_PREVIEW_EVERY = 15  # moments
_RECENT = 30  # moments whose median sharpness is usual
_BLURRED = 0.7  # of the usual sharpness
_EARLY, _LATE = 0.95, 1.3  # steps after which a sharp moment is taken, and after which a blurred one is taken too


@dataclass(frozen=True)
class RecordedStation:
    """A station that was written."""

    number: int  # its number, from 0
    moved: float | None  # metres from the station before; None for the first, and where the motion was lost
    faults: tuple[str, ...]  # its faults, a phrase each


def record(
    moments: Iterable[Station],
    rig: Rig,
    folder: Path,
    step: float = 0.10,
    requested: Callable[[], bool] = lambda: False,
    on_station: Callable[[RecordedStation], None] = lambda station: None,
) -> int:
    """Write stations from camera images until these end; stations already written stay readable in any case.

    Args:
        moments: Images of the cameras, moment by moment.
        rig: The cameras.
        folder: Folder of the recording.
        step: Metres of motion after which a station is taken automatically; 0 takes only those requested.
        requested: Returns whether a station is taken of the next moment; called at each.
        on_station: Called after each station.

    Returns:
        The number of stations.

    Raises:
        FileFormatError: The folder already holds a recording.
    """
    writer = RecordingWriter(folder, folder.name, rig)
    odometer = Odometer(step or 0.10)
    recent: deque[float] = deque(maxlen=_RECENT)
    for number, moment in enumerate(moments):
        frame = moment.frames[rig.reference]
        odometer.add(frame)
        recent.append(sharpness(frame))
        if number % _PREVIEW_EVERY == 0:
            write_atomically(folder / PREVIEW, encode_png(preview(moment)))
        if not (requested() or (step > 0 and _due(writer.count, odometer.moved, step, recent))):
            continue
        moved = None if writer.count == 0 or odometer.lost else odometer.moved
        writer.add(moment)
        writer.save_index()
        on_station(RecordedStation(writer.count - 1, moved, station_faults(moment, rig.reference, moved)))
        odometer = Odometer(step or 0.10)
        odometer.add(frame)
    return writer.count


def _due(count: int, moved: float, step: float, recent: deque[float]) -> bool:
    if count and moved < _EARLY * step:
        return False
    return recent[-1] >= _BLURRED * float(np.median(recent)) or moved > _LATE * step


def preview(moment: Station) -> npt.NDArray[np.uint8]:
    """Draw the cameras side by side (h, w, 3), pixels beyond the plants or without depth at a third of brightness."""
    images = [_darkened(frame) for frame in moment.frames.values()]
    tallest = max(len(image) for image in images)
    return np.concatenate([np.pad(image, ((0, tallest - len(image)), (0, 0), (0, 0))) for image in images], axis=1)


def _darkened(frame: RgbdFrame) -> npt.NDArray[np.uint8]:
    color = frame.color[::2, ::2]
    return np.where(plant_mask(frame)[::2, ::2, None], color, color // 3).astype(np.uint8)
