"""Draw good and bad recordings side by side, with the verdict that import gives: color above, depth below.

A simulated walk of four stations, as it is and spoiled on purpose. Half a minute.

    python benchmarks/recording_pictures.py
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from results_file import RESULTS

from greenhouse_gym.capture import Recording, RgbdFrame, Rig, Station, simulate_recording, three_camera_rig
from greenhouse_gym.capture.inspection import inspect_recording
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.crops import grow_row

SEED, STATIONS, WIDTH = 1, 4, 300
FARTHEST = 1.5  # m, drawn darkest


def brighter(frame: RgbdFrame, factor: float) -> RgbdFrame:
    """The frame with another exposure."""
    return replace(frame, color=np.clip(frame.color * factor, 0, 255).astype(np.uint8))


def sunny(frame: RgbdFrame) -> RgbdFrame:
    """The frame without depth where the sun shines on plants, in large patches."""
    random = np.random.default_rng(0)
    patches = cv2.resize(random.random((12, 8)), frame.depth.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return replace(frame, depth=np.where(patches > 0.3, 0.0, frame.depth).astype(np.float32))


def from_afar(frame: RgbdFrame) -> RgbdFrame:
    """The frame as if everything were three times as far away."""
    return replace(frame, depth=(frame.depth * 3.0).astype(np.float32))


SPOILED: dict[str, Callable[[RgbdFrame], RgbdFrame]] = {
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
    walk = Recording("walk", alone, STATIONS, stations.__getitem__)
    columns = []
    for name, spoil in SPOILED.items():
        seen = [Station({alone.reference: spoil(one.frames[alone.reference])}) for one in stations]
        found = inspect_recording(replace(walk, load=seen.__getitem__))
        print(f"{name}: {'; '.join(found.verdict)}")
        columns.append(column(name, seen[0].frames[alone.reference]))
    picture = np.concatenate(columns, axis=1)
    write_atomically(RESULTS / "recordings_good_and_bad.jpg", cv2.imencode(".jpg", picture[..., ::-1])[1].tobytes())


def column(name: str, frame: RgbdFrame) -> np.ndarray:
    """Color above depth, under a title, of a camera that stands in portrait."""
    near = np.where(frame.depth > 0, 255 * (1.0 - np.clip(frame.depth / FARTHEST, 0.0, 0.9)), 0).astype(np.uint8)
    images = [cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE) for image in (frame.color, cv2.merge([near, near, near]))]
    height = round(WIDTH * images[0].shape[0] / images[0].shape[1])
    title = np.full((40, WIDTH, 3), 255, np.uint8)
    cv2.putText(title, name, (8, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (0, 110, 0) if name == "good" else (180, 0, 0), 2)
    stacked = np.concatenate([title, *(cv2.resize(image, (WIDTH, height)) for image in images)])
    return np.pad(stacked, ((0, 0), (0, 6), (0, 0)), constant_values=255)


if __name__ == "__main__":
    main()
