"""Draw good and bad recordings side by side, color above depth, and print the verdict of the import on each.

A simulated walk of four stations, unchanged and degraded in several ways. Takes half a minute.

python -m benchmarks.sensing.recording_pictures
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.common import RESULTS
from greenhouse_gym.capture import Recording, RgbdFrame, Rig, Station, simulate_recording, three_camera_rig
from greenhouse_gym.capture.inspection import inspect_recording
from greenhouse_gym.crops import grow_row

SEED, STATIONS = 1, 4
MAX_DEPTH = 1.5  # m, drawn darkest


def brighter(frame: RgbdFrame, factor: float) -> RgbdFrame:
    """Return the frame with another exposure."""
    return replace(frame, color=np.clip(frame.color * factor, 0, 255).astype(np.uint8))


def sunny(frame: RgbdFrame) -> RgbdFrame:
    """Return the frame without depth in large patches, as where the sun shines on plants."""
    patches = cv2.resize(
        np.random.default_rng(0).random((12, 8)), frame.depth.shape[::-1], interpolation=cv2.INTER_CUBIC
    )
    return replace(frame, depth=np.where(patches > 0.3, 0.0, frame.depth).astype(np.float32))


def from_afar(frame: RgbdFrame) -> RgbdFrame:
    """Return the frame as seen from three times the distance."""
    return replace(frame, depth=(frame.depth * 3.0).astype(np.float32))


DEGRADED: dict[str, Callable[[RgbdFrame], RgbdFrame]] = {
    "good": lambda frame: frame,
    "too dark": lambda frame: brighter(frame, 0.15),
    "burnt out": lambda frame: brighter(frame, 15.0),
    "sun on the plants": sunny,
    "too far": from_afar,
}


def main() -> None:
    """Write ``benchmarks/results/recordings_good_and_bad.jpg`` and print the verdicts."""
    rig = three_camera_rig()
    alone = Rig({rig.reference: rig.cameras[rig.reference]}, rig.reference)
    stations = list(simulate_recording(grow_row(SEED, 0.6), SEED, alone, STATIONS))
    recording = Recording("walk", alone, STATIONS, stations.__getitem__)
    figure, axes = plt.subplots(2, len(DEGRADED), figsize=(15, 10), layout="constrained")
    for (name, degrade), (above, below) in zip(DEGRADED.items(), axes.T, strict=True):
        degraded = [Station({alone.reference: degrade(one.frames[alone.reference])}) for one in stations]
        print(f"{name}: {'; '.join(inspect_recording(replace(recording, load=degraded.__getitem__)).verdict)}")
        frame = degraded[0].frames[alone.reference]  # of a camera in portrait orientation
        above.imshow(np.rot90(frame.color, -1))
        above.set_title(name, color="darkgreen" if name == "good" else "firebrick")
        below.imshow(np.rot90(np.where(frame.depth > 0, frame.depth, np.inf), -1), cmap="gray_r", vmax=MAX_DEPTH)
        for axis in (above, below):
            axis.axis("off")
    figure.savefig(RESULTS / "recordings_good_and_bad.jpg", dpi=100)


if __name__ == "__main__":
    main()
