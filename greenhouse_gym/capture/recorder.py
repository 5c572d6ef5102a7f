"""Recording on the spot: stations out of what the cameras show, each written at once and looked at.

Where the pictures come from is left open: whatever gives `Station` after `Station` will do, RealSense cameras
(`greenhouse_gym.capture.realsense`) or a recording that is played back.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.formats.stations import Odometer, sharpness_of
from greenhouse_gym.capture.frames import RgbdFrame, Station
from greenhouse_gym.capture.images import encode_png
from greenhouse_gym.capture.inspection import faults_of, near_plants
from greenhouse_gym.capture.recordings import RecordingWriter
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.common.files import write_atomically

PREVIEW = "preview.png"
"""What the cameras show, beside the recording, with all that is too far for plants darkened; renewed on the way."""

_RENEWED = 15  # moments from one preview to the next
_RECENT = 30  # moments among which a sharp one is told from a blurred one
_BLURRED = 0.7  # of their usual sharpness
_EARLY, _LATE = 0.95, 1.3  # steps after which a sharp one is taken, and after which a blurred one is all the same


@dataclass(frozen=True)
class Taken:
    """A station that was written.

    Attributes:
        number: Its number, from 0.
        moved: Metres from the station before; None for the first, and where that could not be told.
        faults: What is wrong with it, a phrase each.
    """

    number: int
    moved: float | None
    faults: tuple[str, ...]


def record(
    moments: Iterable[Station],
    rig: Rig,
    folder: Path,
    step: float = 0.10,
    asked: Callable[[], bool] = lambda: False,
    on_station: Callable[[Taken], None] = lambda taken: None,
) -> int:
    """Write stations of what cameras show until that ends; whatever ends it, what is written stays readable.

    Args:
        moments: What the cameras show, moment by moment.
        rig: The cameras.
        folder: Where the recording goes.
        step: Metres by which the images must have moved for a station by itself; 0 takes none but those asked for.
        asked: Whether a station shall be taken of the next moment; called at each.
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
        odometer.see(frame)
        recent.append(sharpness_of(frame))
        if number % _RENEWED == 0:
            write_atomically(folder / PREVIEW, encode_png(preview(moment)))
        if not (asked() or (step > 0 and _due(writer.count, odometer.moved, step, recent))):
            continue
        moved = None if writer.count == 0 or odometer.lost else odometer.moved
        writer.add(moment)
        writer.save_index()
        on_station(Taken(writer.count - 1, moved, faults_of(moment, rig.reference, moved)))
        odometer = Odometer(step or 0.10)
        odometer.see(frame)
    return writer.count


def _due(count: int, moved: float, step: float, recent: deque[float]) -> bool:
    if count and moved < _EARLY * step:
        return False
    return recent[-1] >= _BLURRED * float(np.median(recent)) or moved > _LATE * step


def preview(moment: Station) -> npt.NDArray[np.uint8]:
    """The cameras side by side (h, w, 3), what is too far for plants, or has no depth, at a third of its brightness."""
    images = [_darkened(frame) for frame in moment.frames.values()]
    tallest = max(len(image) for image in images)
    return np.concatenate([np.pad(image, ((0, tallest - len(image)), (0, 0), (0, 0))) for image in images], axis=1)


def _darkened(frame: RgbdFrame) -> npt.NDArray[np.uint8]:
    color = frame.color[::2, ::2]
    return np.where(near_plants(frame)[::2, ::2, None], color, color // 3).astype(np.uint8)
