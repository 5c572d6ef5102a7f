"""Recordings to a bank: reconstruct each row, extract its shapes, cut scenes out of it, certify their targets."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.recordings import INDEX, Recording
from greenhouse_gym.crop import Stem, Tomato
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.geometry import Array, Box, Capsule, Shape, Sphere, distance_to_shapes, invert, pose, transform
from greenhouse_gym.planning import certify_targets
from greenhouse_gym.plants.truth import truth_of
from greenhouse_gym.progress import CONSOLE
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, reconstruct_row, settings_for
from greenhouse_gym.scene import Provenance, Scene, SceneBank, Shapes, Stand
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.shapes import RowShapes, ShapeSettings, extract_shapes

DECIMALS = 5  # 0.01 mm


@dataclass(frozen=True)
class BuildSettings:
    """How scenes are cut out of a row, and all settings of the stages before. Lengths are metres."""

    spacing: float = 0.5  # between the stands of two scenes of a row
    width: float = 1.6  # of a scene, along the row
    stem_distance: float = 0.60  # from the arm's base axis to the stem line
    reach: float = 1.35  # from the shoulder; what lies farther is left out
    primitives: int = 300  # most in a scene
    robot: str = "ur5e"
    reconstruction: ReconstructionSettings | None = None  # by default what each recording's protocol needs
    shapes: ShapeSettings = field(default_factory=ShapeSettings)


def build_bank(
    recordings: Sequence[Recording],
    out: str | Path,
    name: str,
    splits: Sequence[str] | None = None,
    weeks: Sequence[int | None] | None = None,
    settings: BuildSettings | None = None,
    description: str = "",
    on_stage: Callable[[str], None] | None = None,
) -> SceneBank:
    """Build a bank of scenes from recordings, one row each.

    Scenes are written as they are finished and the manifest last, so an interrupted build goes on with the rows that
    are missing; a scene file made with other settings or another version is made anew.

    Args:
        recordings: One per row; their names become the rows' names.
        out: The bank's folder.
        name: The bank's name.
        splits: Split of each row; by default two thirds train, the rest validation and test in turn.
        weeks: Growth week of each row, where known.
        settings: All settings.
        description: A sentence on where the bank comes from.
        on_stage: Told what is being done, row by row.

    Raises:
        InvalidValueError: No recordings, two of one name, or lists of different lengths.
        ReconstructionError: A recording could not be turned into a row.
    """
    settings = settings or BuildSettings()
    names = [recording.name for recording in recordings]
    splits = default_splits(len(recordings)) if splits is None else splits
    weeks = [None] * len(recordings) if weeks is None else weeks
    if not recordings or len(set(names)) != len(names) or not len(names) == len(splits) == len(weeks):
        raise InvalidValueError(
            f"expected recordings with different names, each with a split and a week; got {names}, {splits}, {weeks}"
        )
    report = on_stage or (lambda text: CONSOLE.print(text, highlight=False))
    folder = Path(out)
    scenes: list[tuple[Scene, str]] = []
    for recording, split, week in zip(recordings, splits, weeks, strict=True):
        fitted = replace(settings, reconstruction=settings.reconstruction or settings_for(recording))
        made = finished_scenes(folder, recording, week, fitted)
        if made:
            report(f"{recording.name}: {len(made)} scenes already built")
        else:
            report(f"{recording.name}: reconstructing {len(recording)} stations")
            row = reconstruct_row(recording, fitted.reconstruction)
            report(f"{recording.name}: extracting shapes from {len(row)} points")
            shapes = extract_shapes(row.points, row.colors, row.normals, settings.shapes)
            made = cut_scenes(row, shapes, recording, week, fitted)
            report(f"{recording.name}: certifying the targets of {len(made)} scenes")
            made = [
                scene.model_copy(update={"targets": certify_targets(scene, settings.robot, seed=0)}) for scene in made
            ]
            for scene in made:
                scene.save(folder / f"{scene.name}.json")
        scenes += [(scene, split) for scene in made]
    return write_bank(folder, scenes, name, description)


def default_splits(rows: int) -> list[str]:
    """Two thirds of the rows for training, the others for validation and test in turn."""
    train = max(1, round(2 * rows / 3))
    return ["train"] * train + ["validation" if k % 2 == 0 else "test" for k in range(rows - train)]


def finished_scenes(folder: Path, recording: Recording, week: int | None, settings: BuildSettings) -> list[Scene]:
    """Scenes of a recording that an earlier build left in the folder, if they were made the same way; else none."""
    try:
        found = [
            Scene.load(folder / f"{scene_name(recording, k)}.json")
            for k in range(len(stand_positions(recording, settings)))
        ]
    except FileFormatError:
        return []
    same = all(
        (made.settings, made.package_version, made.recording_sha256, made.week)
        == (_plain(settings), version("greenhouse-gym"), _fingerprint(recording), week)
        for made in (scene.provenance for scene in found)
    ) and all((scene.truth is None) == (recording.truth is None) for scene in found)
    return found if same else []


def scene_name(recording: Recording, stand: int) -> str:
    """Name of the scene at a stand of a recording, counted from 0."""
    return f"{recording.name}-{stand:02d}"


def stand_positions(recording: Recording, settings: BuildSettings) -> list[float]:
    """Where along the nominal walk, metres from its start, the arm is put up: evenly, half a spacing from the ends."""
    later = recording.passes[1:]
    length = 0.1 * (later[0].first if later else len(recording))
    count = max(1, int(length / settings.spacing + 1e-9) - 1)
    return [float(y) for y in length / 2 + settings.spacing * (np.arange(count) - (count - 1) / 2)]


def level(row: RowCloud) -> Array:
    """(4, 4) pose of the row cloud's frame in a level one.

    A tripod is put up level within a degree or two at every station; the mean of all stations is better than the first,
    whose frame the cloud is in.
    """
    rotations = Rotation.from_matrix(row.world_from_station[row.registered][:, :3, :3])
    return pose(rotations.mean().inv().as_matrix())


def cut_scenes(
    row: RowCloud, shapes: RowShapes, recording: Recording, week: int | None, settings: BuildSettings
) -> list[Scene]:
    """Put the arm up at every stand along a row and keep what is around it.

    Args:
        row: The reconstructed row.
        shapes: What was found in it, in the row's frame.
        recording: What it was reconstructed from.
        week: Growth week, if known.
        settings: All settings.

    Returns:
        Scenes without targets; each frame has its origin on the floor below the arm.
    """
    leveled = level(row)
    tomatoes, stems, clutter = (
        [_moved(shape, leveled) for shape in part] for part in (shapes.tomatoes, shapes.stems, shapes.clutter)
    )
    stem_line = _stem_line(stems, recording)
    heads = transform(leveled, row.world_from_station[row.registered][:, :3, 3])
    numbers = np.flatnonzero(row.registered)
    direction = (
        -1.0 if heads[np.argmax(np.abs(heads[:, 1])), 1] < 0 else 1.0
    )  # the tripod may have gone either way along the row
    truth = None if recording.truth is None else _registered_truth(recording, row, leveled)
    scenes = []
    for k, walked in enumerate(stand_positions(recording, settings)):
        along = direction * walked
        origin = np.array([stem_line - settings.stem_distance, along, 0.0])
        shift = pose(translation=-origin)
        near = [
            _within_reach([_moved(shape, shift) for shape in part], settings.reach, settings.width)
            for part in (tomatoes, stems, clutter)
        ]
        near = _at_most(near, settings.primitives)
        scenes.append(
            Scene(
                name=scene_name(recording, k),
                tomatoes=tuple(s for s in near[0] if isinstance(s, Tomato)),
                stems=tuple(s for s in near[1] if isinstance(s, Stem)),
                clutter=tuple(near[2]),
                stand=Stand(),
                truth=None if truth is None else _around(truth, shift, settings),
                provenance=Provenance(
                    row=recording.name,
                    station=int(numbers[np.argmin(np.abs(heads[:, 1] - along))]),
                    week=week,
                    recording=recording.name,
                    recording_sha256=_fingerprint(recording),
                    settings=_plain(settings),
                    package_version=version("greenhouse-gym"),
                ),
            )
        )
    return scenes


def _registered_truth(recording: Recording, row: RowCloud, leveled: Array) -> Shapes:
    """The true row in the leveled frame of the cloud, by the true pose of the first registered station; never fitted.

    Raises:
        InvalidValueError: The recording does not say where that station stood.
    """
    assert recording.truth is not None
    first = int(np.flatnonzero(row.registered)[0])
    true_from_station = recording[first].world_from_station
    if true_from_station is None:
        raise InvalidValueError(
            f"recording {recording.name!r} carries the truth of its row but not where station {first} stood: give its "
            "stations their world_from_station, or leave the truth out (remove truth.npz)"
        )
    frame = leveled @ row.world_from_station[first] @ invert(true_from_station)
    true = truth_of(recording.truth)
    parts = ([_moved(shape, frame) for shape in part] for part in (true.tomatoes, true.stems, true.clutter))
    return _shapes(*parts)


def _around(truth: Shapes, shift: Array, settings: BuildSettings) -> Shapes:
    """All of the truth within the arm's reach, in the scene's frame."""
    near = (
        _within_reach([_moved(shape, shift) for shape in part], settings.reach)
        for part in (truth.tomatoes, truth.stems, truth.clutter)
    )
    return _shapes(*near).compact()


def _shapes(tomatoes: Sequence[Shape], stems: Sequence[Shape], clutter: Sequence[Shape]) -> Shapes:
    return Shapes(
        tomatoes=tuple(s for s in tomatoes if isinstance(s, Tomato)),
        stems=tuple(s for s in stems if isinstance(s, Stem)),
        clutter=tuple(s for s in clutter if isinstance(s, Sphere | Capsule | Box)),
    )


def _stem_line(stems: list[Shape], recording: Recording) -> float:
    """Distance of the stem line from the tripod's line: the median of the main stems, else the nominal half metre."""
    main = [(s.start[0] + s.end[0]) / 2 for s in stems if isinstance(s, Stem) and s.kind == "main"]
    camera = recording.rig.cameras[recording.rig.reference].rig_from_camera[0, 3]
    return float(np.median(main)) if main else float(camera) + 0.5


def _within_reach(shapes: list[Shape], reach: float, width: float = np.inf) -> list[Shape]:
    """The shapes within the arm's reach whose middles lie within a width along the row."""
    if not shapes:
        return []
    shoulder = np.array([0.0, 0.0, Stand().shoulder_height])
    distance = distance_to_shapes(shoulder[None], shapes)[0]
    return [
        shape for shape, far in zip(shapes, distance, strict=True) if far < reach and abs(_middle(shape)[1]) < width / 2
    ]


def _at_most(parts: list[list[Shape]], most: int) -> list[list[Shape]]:
    """All shapes if they are few enough; else the pedicels, which matter least, go first, those far away before others.

    What is still too much goes by its distance from the shoulder: the arm meets the farthest last.
    """
    everything = [shape for part in parts for shape in part]
    if len(everything) <= most:
        return parts
    distance = distance_to_shapes(np.array([[0.0, 0.0, Stand().shoulder_height]]), everything)[0]
    pedicel = [isinstance(shape, Stem) and shape.kind == "pedicel" for shape in everything]
    keep = {id(everything[i]) for i in np.lexsort([distance, pedicel])[:most]}
    return [[shape for shape in part if id(shape) in keep] for part in parts]


def _middle(shape: Shape) -> Array:
    return (shape.start + shape.end) / 2 if isinstance(shape, Capsule) else shape.center


def _moved(shape: Shape, target_from_source: Array) -> Shape:
    """A shape expressed in another frame, rounded to 0.01 mm."""

    def point(p: Array) -> Array:
        return np.round(transform(target_from_source, p[None])[0], DECIMALS)

    if isinstance(shape, Box):
        turned = Rotation.from_matrix(target_from_source[:3, :3] @ shape.rotation).as_matrix()
        return Box(point(shape.center), np.round(shape.half_extents, DECIMALS), np.round(turned, 7))
    radius = round(shape.radius, DECIMALS)
    if isinstance(shape, Tomato):
        turned_axes = None
        if shape.rotation is not None:
            turned_axes = np.round(Rotation.from_matrix(target_from_source[:3, :3] @ shape.rotation).as_matrix(), 7)
        axes = None if shape.semi_axes is None else np.round(shape.semi_axes, DECIMALS)
        return Tomato(point(shape.center), radius, shape.truss, shape.ripeness, axes, turned_axes)
    if isinstance(shape, Stem):
        return Stem(point(shape.start), point(shape.end), radius, shape.kind)
    if isinstance(shape, Capsule):
        return Capsule(point(shape.start), point(shape.end), radius)
    return type(shape)(point(shape.center), radius)


def _plain(settings: BuildSettings) -> dict[str, Any]:
    """Settings as they come back from JSON: tuples as lists."""
    plain: dict[str, Any] = {
        key: {k: list(v) if isinstance(v, tuple) else v for k, v in value.items()} if isinstance(value, dict) else value
        for key, value in asdict(settings).items()
    }
    return plain


def _fingerprint(recording: Recording) -> str | None:
    """Checksum of a recording's index file, or None for one that lies on no disk."""
    if recording.folder is None or not (recording.folder / INDEX).exists():
        return None
    return hashlib.sha256((recording.folder / INDEX).read_bytes()).hexdigest()
