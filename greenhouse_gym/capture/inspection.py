"""Whether a recording is good enough: figures of its images, and a verdict in words with what to do better."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.formats.stations import motion, sharpness_of
from greenhouse_gym.capture.frames import RgbdFrame, Station
from greenhouse_gym.capture.mounting_check import mounting_doubts
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.errors import FileFormatError

_LOOKED_AT = 24  # stations at most
_COMPARED = 3  # stations whose cameras are compared
_NEAR, _FAR = 0.3, 1.2  # m, where plants may be
_MISSING = 0.35  # share of the plants' pixels without depth that is too much
_DARK, _BRIGHT = 40, 225  # median gray of the plants' pixels
_CLIPPED = 0.3  # share of pixels that are burnt out
_BLURRED = 0.35  # of the recording's own usual sharpness
_OVERLAP = 0.55  # of an image that the next one must show as well
_STILL = 0.01  # m
_SMALL_FRUIT = 0.0018  # m across a pixel; a cherry tomato of 25 mm then is 14 pixels wide


@dataclass(frozen=True)
class CameraFigures:
    """What one camera's images are like, each the median over stations.

    Attributes:
        missing: Share of pixels without depth.
        gray: Median gray of the plants' pixels, 0 to 255.
        clipped: Share of the plants' pixels that are burnt out.
        distance: Distance of the plants, metres; 0 where nothing is near.
        near: Share of the image that is near enough to be plants.
        sharpness: Variance of the Laplacian.
        pixel: Metres across a pixel at the plants.
    """

    missing: float
    gray: float
    clipped: float
    distance: float
    near: float
    sharpness: float
    pixel: float


@dataclass(frozen=True)
class Inspection:
    """What a recording is like.

    Attributes:
        stations: Number of stations.
        looked_at: How many of them were looked at.
        unreadable: Numbers of those that could not be read.
        cameras: The figures of each camera, by its name.
        steps: Metres between neighboring stations that were looked at; only where that could be told.
        overlap: Share of an image that the next station shows as well, the median; None if not known.
        histogram: Share of all readings in each 10 cm of distance, from 0 to 3 m.
        good_for_registration: Whether the stations can be expected to fit together.
        good_for_small_fruit: Whether cherry tomatoes will be found.
        verdict: Sentences: what is good, what is not, what to do better.
    """

    stations: int
    looked_at: int
    unreadable: tuple[int, ...]
    cameras: Mapping[str, CameraFigures]
    steps: tuple[float, ...]
    overlap: float | None
    histogram: tuple[float, ...]
    good_for_registration: bool
    good_for_small_fruit: bool
    verdict: tuple[str, ...]


def inspect_recording(recording: Recording) -> Inspection:
    """Look at up to 24 stations, neighbors in pairs, spread over a recording."""
    pairs = max(1, min(_LOOKED_AT, len(recording)) // 2)
    starts = np.unique(np.linspace(0, max(0, len(recording) - 2), pairs).round().astype(int)).tolist()
    figures: dict[str, list[CameraFigures]] = {name: [] for name in recording.rig.cameras}
    unreadable, steps, overlaps = [], [], []
    compared: list[Station] = []
    histogram = np.zeros(30)
    looked_at = 0
    for start in starts:
        before: RgbdFrame | None = None
        for i in range(start, min(start + 2, len(recording))):
            try:
                station = recording[i]
            except FileFormatError:
                unreadable.append(i)
                before = None
                continue
            looked_at += 1
            if len(compared) < _COMPARED:
                compared.append(station)
            own = {name: _figures(frame) for name, frame in station.frames.items()}
            for name, of_camera in own.items():
                figures[name].append(of_camera)
            frame = station.frames[recording.rig.reference]
            histogram += np.histogram(frame.depth[frame.depth > 0], np.linspace(0.0, 3.0, 31))[0]
            moved = None if before is None else motion(before, frame)
            if moved is not None:
                steps.append(moved)
                overlaps.append(_overlap(frame, own[recording.rig.reference].distance, moved))
            before = frame
    if not looked_at:
        raise FileFormatError(recording.folder or recording.name, "none of its stations can be read")
    cameras = {
        name: CameraFigures(*np.median([list(vars(one).values()) for one in all_of], axis=0).tolist())
        for name, all_of in figures.items()
    }
    overlap = float(np.median(overlaps)) if overlaps else None
    blurred = [
        sum(one.sharpness < _BLURRED * cameras[name].sharpness for one in all_of) for name, all_of in figures.items()
    ]
    bad, hints = _faults(cameras, steps, overlap, max(blurred), unreadable)
    if len(recording) < 2:
        bad.append("it is a single station: did the camera move?")
    if doubts := mounting_doubts(recording.rig, compared):
        bad.append(f"the rig does not fit the images: {', or '.join(doubts)}; turn the images, or correct the rig file")
    small = not bad and all(0 < camera.pixel < _SMALL_FRUIT for camera in cameras.values())
    verdict = (
        "good enough for registration" if not bad else "not good enough for registration: " + "; ".join(bad),
        "fine enough for small fruit" if small else _why_not_small(cameras, bool(bad)),
        *hints,
    )
    return Inspection(
        len(recording), looked_at, tuple(unreadable), cameras, tuple(steps), overlap,
        tuple((histogram / max(histogram.sum(), 1)).round(4).tolist()), not bad, small, verdict,
    )  # fmt: skip


def faults_of(station: Station, reference: str, moved: float | None) -> tuple[str, ...]:
    """What is wrong with a single station that moved so many metres from the one before, a phrase each."""
    cameras = {name: _figures(frame) for name, frame in station.frames.items()}
    overlap = None if moved is None else _overlap(station.frames[reference], cameras[reference].distance, moved)
    bad, hints = _faults(cameras, [] if moved is None else [moved], overlap, 0, [])
    return (*bad, *hints)


def near_plants(frame: RgbdFrame) -> npt.NDArray[np.bool_]:
    """Which pixels (height, width) are as near as plants may be."""
    return (frame.depth > _NEAR / 2) & (frame.depth < _FAR)


def _overlap(frame: RgbdFrame, distance: float, moved: float) -> float:
    """Share of an image of plants so many metres away that is still seen when the camera has moved so many metres."""
    k = frame.intrinsics
    width = min(k.width / k.fx, k.height / k.fy)
    return max(0.0, 1.0 - moved / max(width * distance, 1e-6))


def _figures(frame: RgbdFrame) -> CameraFigures:
    depth, near = frame.depth[::2, ::2], near_plants(frame)[::2, ::2]  # every fourth pixel tells as much
    gray = frame.color[::2, ::2].mean(axis=2)
    plants = near if near.any() else np.ones_like(near)
    distance = float(np.median(depth[near])) if near.any() else 0.0
    return CameraFigures(
        missing=float((depth <= 0).mean()),
        gray=float(np.median(gray[plants])),
        clipped=float((gray[plants] > 250).mean()),
        distance=distance,
        near=float(near.mean()),
        sharpness=sharpness_of(frame),
        pixel=distance / frame.intrinsics.fx,
    )


def _faults(
    cameras: Mapping[str, CameraFigures], steps: list[float], overlap: float | None, blurred: int, unreadable: list[int]
) -> tuple[list[str], list[str]]:
    """What keeps stations from being registered, and what could be better."""
    bad, hints = [], []
    for name, camera in cameras.items():
        if camera.near < 0.02:
            bad.append(f"camera {name} sees next to nothing between {_NEAR} and {_FAR} m: go nearer to the plants")
        elif camera.missing > _MISSING:
            hints.append(
                f"camera {name} has no depth at {camera.missing:.0%} of its pixels: if plants are among them, "
                "less sun, and 0.4 to 0.8 m away"
            )
        if camera.gray < _DARK:
            bad.append(f"camera {name} is too dark (median gray {camera.gray:.0f}): more light or longer exposure")
        elif camera.gray > _BRIGHT or camera.clipped > _CLIPPED:
            bad.append(f"camera {name} is overexposed ({camera.clipped:.0%} burnt out): shorter exposure")
    if steps and float(np.median(steps)) < _STILL:
        bad.append("the camera hardly moves from station to station: choose fewer frames, or walk on")
    if overlap is not None and overlap < _OVERLAP:
        bad.append(
            f"neighboring stations share {overlap:.0%} of an image, {_OVERLAP:.0%} or more needed: smaller steps"
        )
    if blurred:
        hints.append(f"{blurred} images are blurred: stand still, walk slower, or expose shorter")
    if unreadable:
        hints.append(f"{len(unreadable)} stations cannot be read: {unreadable[:10]}")
    return bad, hints


def _why_not_small(cameras: Mapping[str, CameraFigures], bad: bool) -> str:
    coarse = max(cameras.items(), key=lambda each: each[1].pixel)
    if bad or coarse[1].pixel < _SMALL_FRUIT:
        return "not good enough for small fruit"
    return (
        f"too coarse for small fruit: a pixel of camera {coarse[0]} is {1e3 * coarse[1].pixel:.1f} mm wide, "
        f"{1e3 * _SMALL_FRUIT:.1f} mm or less needed: go nearer or take a finer depth mode"
    )
