"""Recordings with broken stations: black images, a hand in the view, a displaced tripod, duplicates."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture import Recording, RgbdFrame, Station

KINDS = ("black", "hand", "displaced", "duplicate")
DISPLACED_BY = 4  # stations of 10 cm
SKIN = np.array([205.0, 150.0, 125.0])  # RGB


class BrokenRecording(NamedTuple):
    """A recording with broken stations.

    Attributes:
        recording: Each station carries the true pose from which its images were taken.
        broken: One of `KINDS` for each broken station.
    """

    recording: Recording
    broken: Mapping[int, str]


def break_stations(recording: Recording, fraction: float = 0.15, seed: int = 0) -> BrokenRecording:
    """Break a fraction of the stations, but never the first; all kinds are equally frequent.

    - ``black``: neither depth nor color.
    - ``hand``: something of skin color, 20 to 25 cm away, covers 40 to 70 % of the reference camera's image and 10 to
      30 % of the others'.
    - ``displaced``: the tripod stood 40 cm further along the row (or back, near its end) and then returned.
    - ``duplicate``: the data of the previous station, good or broken, once more.

    Args:
        recording: Any recording.
        fraction: Fraction of the stations to break.
        seed: Seed of the choice and of the hands.
    """
    rng = np.random.default_rng([seed, 3])
    chosen = rng.permutation(np.arange(1, len(recording)))[: round(fraction * len(recording))]
    broken = {int(i): KINDS[k % len(KINDS)] for k, i in enumerate(chosen)}

    def load(i: int) -> Station:
        match broken.get(i):
            case "black":
                return _each_frame(recording[i], lambda _, frame: _black(frame))
            case "hand":
                own = np.random.default_rng([seed, 4, i])
                reference = recording.rig.reference
                return _each_frame(recording[i], lambda name, frame: _behind_hand(frame, name == reference, own))
            case "displaced":
                return recording[i + DISPLACED_BY if i + DISPLACED_BY < len(recording) else i - DISPLACED_BY]
            case "duplicate":
                return load(i - 1)
            case _:
                return recording[i]

    spoiled = replace(recording, name=f"{recording.name}-broken", load=load, folder=None)
    return BrokenRecording(spoiled, dict(sorted(broken.items())))


def _each_frame(station: Station, change: Callable[[str, RgbdFrame], RgbdFrame]) -> Station:
    frames = {name: change(name, frame) for name, frame in station.frames.items()}
    return Station(frames, station.world_from_station)


def _black(frame: RgbdFrame) -> RgbdFrame:
    return RgbdFrame(np.zeros_like(frame.color), np.zeros_like(frame.depth), frame.intrinsics)


def _behind_hand(frame: RgbdFrame, reference: bool, rng: np.random.Generator) -> RgbdFrame:
    """Return the frame with an oval in front of a part of it that bulges towards the camera."""
    height, width = frame.depth.shape
    row, column = rng.uniform(0.3, 0.7, 2) * (height, width)
    v, u = np.mgrid[:height, :width]
    outward = ((v - row) / height) ** 2 + ((u - column) / width) ** 2
    outward /= np.quantile(outward, rng.uniform(0.4, 0.7) if reference else rng.uniform(0.1, 0.3))
    covered = outward < 1.0
    surface = rng.uniform(0.20, 0.22) + 0.03 * outward + rng.normal(0.0, 0.0005, outward.shape)
    depth = np.where(covered, np.rint(1000 * surface) / 1000, frame.depth).astype(np.float32)
    shade = (1.0 - 0.4 * np.minimum(outward, 1.0))[..., None] * SKIN + rng.normal(0.0, 2.5, frame.color.shape)
    color: npt.NDArray[np.uint8] = np.where(covered[..., None], np.clip(shade, 0, 255), frame.color).astype(np.uint8)
    return RgbdFrame(color, depth, frame.intrinsics)
