"""Inspection of recordings: figures of the images, a verdict, and advice on better ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import RgbdFrame, Rig, Station
from greenhouse_gym.capture.station_selection import motion, sharpness
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import invert, transform

_MAX_STATIONS = 24  # that are inspected
_COMPARED = 3  # stations whose cameras are compared
_NEAR, _FAR = 0.3, 1.2  # m, where plants may be
_MAX_MISSING = 0.35  # fraction of the pixels without depth
_DARK, _BRIGHT = 40, 225  # median gray of the plants' pixels
_CLIPPED = 0.3  # fraction of pixels that are burnt out
_BLURRED = 0.35  # of the recording's own usual sharpness
_MIN_OVERLAP = 0.55  # fraction of an image that the next one must show as well
_STILL = 0.01  # m
_FARTHEST = 1.5  # m
_EVERY = 6  # rows and columns of an image that are compared
_SAME_DEPTH = 0.03  # m
_MIN_SHARED = 200  # readings that two cameras must share
_REQUIRED_GAIN = 0.15  # fraction of readings by which another explanation must fit better
_TIE = 0.05  # fraction of readings by which two explanations are indistinguishable
_SMALL_FRUIT = 0.0018  # m across a pixel; a cherry tomato of 25 mm then is 14 pixels wide


@dataclass(frozen=True)
class CameraFigures:
    """Figures of one camera's images, each the median over stations."""

    missing: float  # fraction of pixels without depth
    gray: float  # median gray of the plants' pixels, 0 to 255
    clipped: float  # fraction of the plants' pixels that are burnt out
    distance: float  # distance of the plants, metres; 0 without any near surface
    near: float  # fraction of the image that is near enough to be plants
    sharpness: float  # variance of the Laplacian
    pixel: float  # metres across a pixel at the plants


@dataclass(frozen=True)
class Inspection:
    """Result of the inspection of a recording."""

    stations: int
    inspected: int
    unreadable: tuple[int, ...]  # numbers of those that could not be read
    cameras: Mapping[str, CameraFigures]
    steps: tuple[float, ...]  # metres between neighboring stations, where the motion could be measured
    overlap: float | None  # fraction of an image that the next station shows as well, the median; None if not known
    histogram: tuple[float, ...]  # fraction of all readings in each 10 cm of distance, from 0 to 3 m
    good_for_registration: bool  # whether the stations can be expected to register
    good_for_small_fruit: bool  # whether cherry tomatoes can be expected to be found
    verdict: tuple[str, ...]  # sentences: the verdicts, and advice


def inspect_recording(recording: Recording) -> Inspection:
    """Inspect up to 24 stations, neighbors in pairs, spread over a recording."""
    pairs = max(1, min(_MAX_STATIONS, len(recording)) // 2)
    starts = np.unique(np.linspace(0, max(0, len(recording) - 2), pairs).round().astype(int)).tolist()
    figures: dict[str, list[CameraFigures]] = {name: [] for name in recording.rig.cameras}
    unreadable, steps, overlaps = [], [], []
    compared: list[Station] = []
    histogram = np.zeros(30)
    inspected = 0
    for start in starts:
        before: RgbdFrame | None = None
        for i in range(start, min(start + 2, len(recording))):
            try:
                station = recording[i]
            except FileFormatError:
                unreadable.append(i)
                before = None
                continue
            inspected += 1
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
    if not inspected:
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
    if doubts := _mounting_doubts(recording.rig, compared):
        bad.append(f"the rig does not fit the images: {', or '.join(doubts)}; turn the images, or correct the rig file")
    small = not bad and all(0 < camera.pixel < _SMALL_FRUIT for camera in cameras.values())
    verdict = (
        "good enough for registration" if not bad else "not good enough for registration: " + "; ".join(bad),
        "fine enough for small fruit" if small else _small_fruit_problem(cameras, bool(bad)),
        *hints,
    )
    return Inspection(
        len(recording),
        inspected,
        tuple(unreadable),
        cameras,
        tuple(steps),
        overlap,
        tuple((histogram / max(histogram.sum(), 1)).round(4).tolist()),
        good_for_registration=not bad,
        good_for_small_fruit=small,
        verdict=verdict,
    )


def station_faults(station: Station, reference: str, moved: float | None) -> tuple[str, ...]:
    """Return the faults of a single station, ``moved`` metres from the one before, a phrase each."""
    cameras = {name: _figures(frame) for name, frame in station.frames.items()}
    overlap = None if moved is None else _overlap(station.frames[reference], cameras[reference].distance, moved)
    bad, hints = _faults(cameras, [] if moved is None else [moved], overlap, 0, [])
    return (*bad, *hints)


def plant_mask(frame: RgbdFrame) -> npt.NDArray[np.bool_]:
    """Mask the pixels (height, width) that are near enough to be plants."""
    return (frame.depth > _NEAR / 2) & (frame.depth < _FAR)


def _overlap(frame: RgbdFrame, distance: float, moved: float) -> float:
    """Return the fraction of an image of plants at a distance that stays in view after a motion, both metres."""
    k = frame.intrinsics
    width = min(k.width / k.fx, k.height / k.fy)
    return max(0.0, 1.0 - moved / max(width * distance, 1e-6))


def _figures(frame: RgbdFrame) -> CameraFigures:
    depth, near = frame.depth[::2, ::2], plant_mask(frame)[::2, ::2]  # every fourth pixel is enough
    gray = frame.color[::2, ::2].mean(axis=2)
    plants = near if near.any() else np.ones_like(near)
    distance = float(np.median(depth[near])) if near.any() else 0.0
    return CameraFigures(
        missing=float((depth <= 0).mean()),
        gray=float(np.median(gray[plants])),
        clipped=float((gray[plants] > 250).mean()),
        distance=distance,
        near=float(near.mean()),
        sharpness=sharpness(frame),
        pixel=distance / frame.intrinsics.fx,
    )


def _faults(
    cameras: Mapping[str, CameraFigures], steps: list[float], overlap: float | None, blurred: int, unreadable: list[int]
) -> tuple[list[str], list[str]]:
    """Return faults that prevent registration, and hints on better images."""
    bad, hints = [], []
    for name, camera in cameras.items():
        if camera.near < 0.02:
            bad.append(f"camera {name} sees almost nothing between {_NEAR} and {_FAR} m: go nearer to the plants")
        elif camera.missing > _MAX_MISSING:
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
    if overlap is not None and overlap < _MIN_OVERLAP:
        needed = f"{_MIN_OVERLAP:.0%} or more needed"
        bad.append(f"neighboring stations share {overlap:.0%} of an image, {needed}: smaller steps")
    if blurred:
        hints.append(f"{blurred} images are blurred: stand still, walk slower, or expose shorter")
    if unreadable:
        hints.append(f"{len(unreadable)} stations cannot be read: {unreadable[:10]}")
    return bad, hints


def _small_fruit_problem(cameras: Mapping[str, CameraFigures], bad: bool) -> str:
    name, coarsest = max(cameras.items(), key=lambda each: each[1].pixel)
    if bad or coarsest.pixel < _SMALL_FRUIT:
        return "not good enough for small fruit"
    return (
        f"too coarse for small fruit: a pixel of camera {name} is {1e3 * coarsest.pixel:.1f} mm wide, "
        f"{1e3 * _SMALL_FRUIT:.1f} mm or less needed: go nearer or use a finer depth mode"
    )


Frames = Mapping[str, RgbdFrame]


def _mounting_doubts(rig: Rig, stations: Sequence[Station]) -> tuple[str, ...]:
    """Return probable faults of the camera poses, a phrase each; empty where no other explanation fits much better.

    Tested are pairs of swapped cameras, and upside-down images of one camera or of all. On a rig that looks the same
    when it is turned around, the two are indistinguishable.
    """
    as_given = _agreement(rig, [station.frames for station in stations])
    if as_given is None:
        return ()
    found = {text: _agreement(rig, changed) for text, changed in _explanations(stations)}
    better = {text: fit for text, fit in found.items() if fit is not None and fit > as_given + _REQUIRED_GAIN}
    return tuple(text for text, fit in better.items() if fit > max(better.values()) - _TIE)


def _explanations(stations: Sequence[Station]) -> Iterator[tuple[str, Sequence[Frames]]]:
    """Yield other explanations, each with the frames that it implies."""
    names = list(stations[0].frames)
    for one, other in combinations(names, 2):
        changed = {one: other, other: one}
        swapped = [{name: s.frames[changed.get(name, name)] for name in names} for s in stations]
        yield f"the cameras {one} and {other} seem to be swapped", swapped
    for name in names:
        text = f"the images of camera {name} seem to be upside down"
        yield text, [_with_turned(station.frames, [name]) for station in stations]
    yield "all images seem to be upside down", [_with_turned(s.frames, names) for s in stations]


def _with_turned(frames: Frames, names: Sequence[str]) -> Frames:
    return {name: _upside_down(frame) if name in names else frame for name, frame in frames.items()}


def _upside_down(frame: RgbdFrame) -> RgbdFrame:
    return RgbdFrame(frame.color[::-1, ::-1], frame.depth[::-1, ::-1], frame.intrinsics)


def _agreement(rig: Rig, stations: Sequence[Frames]) -> float | None:
    """Return the fraction of readings in view of two cameras whose depths agree; None if they are too few."""
    same = shared = 0
    for frames in stations:
        for one, other in permutations(frames, 2):
            target = frames[other]
            points = frames[one].grid_points(_EVERY, _FARTHEST)
            moved = transform(invert(rig.cameras[other].rig_from_camera) @ rig.cameras[one].rig_from_camera, points)
            kept, rows, columns = target.intrinsics.project(moved)
            depth = target.depth[rows, columns]
            read = depth > 0
            shared += int(np.count_nonzero(read))
            same += int(np.count_nonzero(np.abs(depth[read] - moved[kept[read], 2]) < _SAME_DEPTH))
    return same / shared if shared >= _MIN_SHARED else None
