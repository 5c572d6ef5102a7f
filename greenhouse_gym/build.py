"""Recordings to a bank: reconstruct each row, extract its shapes, cut scenes out of it, certify their targets."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.fingerprint import fingerprint
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.crop import Stem, Tomato
from greenhouse_gym.errors import FileFormatError, GreenhouseError, InvalidValueError
from greenhouse_gym.extras import require_extras
from greenhouse_gym.geometry import Array, Box, Capsule, Shape, Sphere, distance_to_shapes, invert, pose, transform
from greenhouse_gym.paths import checked_name, exclusive, parsing, read_bytes, write_atomically
from greenhouse_gym.planning import certify_targets
from greenhouse_gym.plants.truth import truth_of
from greenhouse_gym.progress import CONSOLE
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, reconstruct_row, settings_for
from greenhouse_gym.reconstruction.seen import Carving, CarvingSettings, carve
from greenhouse_gym.scene import Provenance, Scene, SceneBank, Shapes, Stand
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.seen import UNSEEN, SeenSpace
from greenhouse_gym.shapes import RowShapes, ShapeSettings, extract_shapes

DECIMALS = 5  # 0.01 mm

UNFINISHED, CUT = "unfinished", "scenes.json"
"""Folder, below the bank's, of what an interrupted build knows; and, in it, per row, the scenes without targets."""

_SCENES = TypeAdapter(list[Scene])


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
    carving: CarvingSettings = field(default_factory=CarvingSettings)


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

    An interrupted build goes on with the station, or the scene, at which it stopped: what is not finished lies in the
    folder ``unfinished`` until the manifest is written, last. What was made of other images, with other settings or by
    another version is made anew.

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
        InvalidValueError: No recordings, two of one name, one that cannot be a file's, or lists of different lengths.
        FileWriteError: The folder cannot be written, or another process is building in it; told before any work.
        MissingDependencyError: OMPL, which certifies the targets, is not installed.
        ReconstructionError: A recording could not be turned into a row.
    """
    settings = settings or BuildSettings()
    names = [checked_name("a recording to build of", recording.name) for recording in recordings]
    splits = default_splits(len(recordings)) if splits is None else splits
    weeks = [None] * len(recordings) if weeks is None else weeks
    if not recordings or len(set(names)) != len(names) or not len(names) == len(splits) == len(weeks):
        raise InvalidValueError(
            f"expected recordings with different names, each with a split and a week; got {names}, {splits}, {weeks}"
        )
    require_extras("reconstruct", "plan")
    report = on_stage or (lambda text: CONSOLE.print(text, highlight=False, markup=False))
    folder = Path(out)
    scenes: list[tuple[Scene, str]] = []
    with exclusive(folder):
        for recording, split, week in zip(recordings, splits, weeks, strict=True):
            fitted = replace(settings, reconstruction=settings.reconstruction or settings_for(recording))
            made = _row_of_scenes(folder, recording, week, fitted, report)
            scenes += [(scene, split) for scene in made]
        bank = write_bank(folder, scenes, name, description)
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
    return bank


def _row_of_scenes(
    folder: Path, recording: Recording, week: int | None, settings: BuildSettings, report: Callable[[str], None]
) -> Sequence[Scene]:
    """The certified scenes of a recording, each saved in the bank's folder."""
    origin = _provenance(recording, week, settings)
    finished = _of_finished_bank(folder, origin)
    if finished:
        report(f"{recording.name}: {len(finished)} scenes already built")
        return finished
    notes = folder / UNFINISHED / recording.name
    cut = _cut_before(notes / CUT, origin)
    if cut is None:
        report(f"{recording.name}: reconstructing {len(recording)} stations")
        row = reconstruct_row(recording, settings.reconstruction, folder=notes)
        report(f"{recording.name}: extracting shapes from {len(row)} points")
        shapes = extract_shapes(row.points, row.colors, row.normals, settings.shapes)
        cut = cut_scenes(row, shapes, recording, week, settings, origin)
        write_atomically(notes / CUT, _SCENES.dump_json(cut))
        for scene in cut:
            report(_what_was_seen(scene, settings))
    report(f"{recording.name}: certifying the targets of {len(cut)} scenes")
    return [_certified(folder, scene, settings) for scene in cut]


def _certified(folder: Path, scene: Scene, settings: BuildSettings) -> Scene:
    """The scene with its targets: as an interrupted build left it in the folder, else certified now and saved there."""
    path = folder / f"{scene.name}.json"
    try:
        found = Scene.load(path)
    except FileFormatError:
        found = scene
    if not found.targets or found.model_copy(update={"targets": ()}).model_dump_json() != scene.model_dump_json():
        found = scene.model_copy(update={"targets": certify_targets(scene, settings.robot, seed=0)})
        found.save(path)
    return found


def _cut_before(path: Path, origin: Provenance) -> list[Scene] | None:
    """Scenes that an interrupted build cut out of the same row in the same way; None where there are none."""
    try:
        with parsing(path, "list of scenes"):
            found = _SCENES.validate_json(read_bytes(path, "scene"))
    except FileFormatError:
        return None
    return found if all(_same(scene, origin) for scene in found) else None


def _of_finished_bank(folder: Path, origin: Provenance) -> list[Scene]:
    """The row's scenes in the bank that lies in the folder, if there is one and they were made in the same way."""
    try:
        bank = SceneBank.open(folder)
        found = [bank.scene(entry.name) for entry in bank.manifest.scenes if entry.row == origin.row]
    except GreenhouseError:
        return []
    return found if all(_same(scene, origin) for scene in found) else []


def _same(scene: Scene, origin: Provenance) -> bool:
    """Whether a scene comes from there, wherever along the row it stands."""
    return scene.provenance.model_copy(update={"station": None}) == origin


def _provenance(recording: Recording, week: int | None, settings: BuildSettings) -> Provenance:
    """Where all scenes of a recording come from."""
    return Provenance(
        row=recording.name,
        week=week,
        recording=recording.name,
        recording_sha256=fingerprint(recording),
        settings=_plain(settings),
        package_version=version("greenhouse-gym"),
    )


def _what_was_seen(scene: Scene, settings: BuildSettings) -> str:
    """A line on how much of the space around an arm the scan saw."""
    if scene.seen is None:
        return f"{scene.name}: what the scan saw is not known"
    shoulder = np.array([0.0, 0.0, Stand().shoulder_height])
    text = f"{scene.name}: {scene.seen.share(shoulder, settings.reach):.0%} of the space within reach was seen"
    plants = scene.seen.states[scene.seen.centers[..., 0] > settings.stem_distance / 2]
    above = scene.seen.centers[..., 2][scene.seen.centers[..., 0] > settings.stem_distance / 2]
    if not (plants[above > shoulder[2]] != UNSEEN).any():
        text += f"; nothing of the plants above {shoulder[2]:g} m: an arm that must not leave it will hardly move"
    return text


def default_splits(rows: int) -> list[str]:
    """Two thirds of the rows for training, the others for validation and test in turn."""
    train = max(1, round(2 * rows / 3))
    return ["train"] * train + ["validation" if k % 2 == 0 else "test" for k in range(rows - train)]


def scene_name(recording: Recording, stand: int) -> str:
    """Name of the scene at a stand of a recording, counted from 0."""
    return f"{recording.name}-{stand:02d}"


def stand_positions(along: Array, settings: BuildSettings) -> list[float]:
    """Where along the row the arm is put up: evenly, at least half a spacing from the ends of the walk.

    Args:
        along: (stations,) where the registered stations stood, metres along the row in any order.
        settings: All settings.

    Returns:
        Metres along the row, the end at which the walk began first.
    """
    first, last = float(along.min()), float(along.max())
    count = max(1, int((last - first) / settings.spacing + 1e-9))
    stands = (first + last) / 2 + settings.spacing * (np.arange(count) - (count - 1) / 2)
    backward = abs(along[0] - first) > abs(along[0] - last)
    return [float(y) for y in (stands[::-1] if backward else stands)]


def level(row: RowCloud) -> Array:
    """(4, 4) pose of the row cloud's frame in a level one.

    A tripod is put up level within a degree or two at every station; the mean of all stations is better than the first,
    whose frame the cloud is in.
    """
    rotations = Rotation.from_matrix(row.world_from_station[row.registered][:, :3, :3])
    return pose(rotations.mean().inv().as_matrix())


def cut_scenes(
    row: RowCloud,
    shapes: RowShapes,
    recording: Recording,
    week: int | None,
    settings: BuildSettings,
    origin: Provenance | None = None,
) -> list[Scene]:
    """Put the arm up at every stand along a row and keep what is around it.

    Args:
        row: The reconstructed row.
        shapes: What was found in it, in the row's frame.
        recording: What it was reconstructed from.
        week: Growth week, if known.
        settings: All settings.
        origin: What the scenes' provenance tells, where it is known already.

    Returns:
        Scenes without targets; each frame has its origin on the floor below the arm.
    """
    leveled = level(row)
    tomatoes, stems, clutter = (
        [_moved(shape, leveled) for shape in part] for part in (shapes.tomatoes, shapes.stems, shapes.clutter)
    )
    heads = transform(leveled, row.world_from_station[row.registered][:, :3, 3])
    numbers = np.flatnonzero(row.registered)
    made_from = origin or _provenance(recording, week, settings)
    places = _stand_origins(stems, heads, recording, settings)
    carving = None if row.sight is None else _carving(row, leveled, places, settings)
    scenes = []
    for k, place in enumerate(places):
        shift = pose(translation=-place)
        station = int(numbers[np.argmin(np.abs(heads[:, 1] - place[1]))])
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
                truth=None
                if recording.truth is None
                else _truth_around(recording, row, station, shift @ leveled, settings),
                seen=None if carving is None else _seen_from(carving, place, settings),
                provenance=made_from.model_copy(update={"station": station}),
            )
        )
    return scenes


def stand_poses(row: RowCloud, shapes: RowShapes, recording: Recording, settings: BuildSettings) -> Array:
    """(stands, 4, 4) where `cut_scenes` puts the arm up: the frame of each scene in that of the row."""
    leveled = level(row)
    heads = transform(leveled, row.world_from_station[row.registered][:, :3, 3])
    origins = _stand_origins([_moved(stem, leveled) for stem in shapes.stems], heads, recording, settings)
    return np.array([invert(leveled) @ pose(translation=origin) for origin in origins])


def _stand_origins(stems: Sequence[Shape], heads: Array, recording: Recording, settings: BuildSettings) -> list[Array]:
    """(3,) points on the floor below the arm, in the leveled frame, of stems and stations (n, 3) in that frame."""
    aside = _stem_line(stems, recording) - settings.stem_distance
    return [np.array([aside, along, 0.0]) for along in stand_positions(heads[:, 1], settings)]


def _carving(row: RowCloud, leveled: Array, stands: Sequence[Array], settings: BuildSettings) -> Carving:
    """The space within reach of all stands, in the leveled frame of the cloud."""
    low, high = _space(settings)
    ends = [stand + corner for stand in stands for corner in (low, high)]
    return carve(row, leveled, np.min(ends, axis=0), np.max(ends, axis=0), settings.carving)


def _seen_from(carving: Carving, stand: Array, settings: BuildSettings) -> SeenSpace:
    low, high = _space(settings)
    states, corner = carving.cut(stand + low, stand + high)
    return SeenSpace.of(states, np.round(corner - stand, DECIMALS), carving.voxel)


def _space(settings: BuildSettings) -> tuple[Array, Array]:
    """Corners (3,) of the space around a stand that an arm may get to, metres."""
    reach = settings.reach
    return np.array([-reach, -reach, 0.0]), np.array([reach, reach, Stand().shoulder_height + reach])


def _truth_around(
    recording: Recording, row: RowCloud, station: int, scene_from_row: Array, settings: BuildSettings
) -> Shapes:
    """All of the true row within the arm's reach, in a scene's frame.

    It is registered by the true pose of the station nearest to the arm, never fitted: that leaves the drift along the
    row out, which an arm put up there would not feel.

    Raises:
        InvalidValueError: The recording does not say where that station stood.
    """
    assert recording.truth is not None
    true_from_station = recording[station].world_from_station
    if true_from_station is None:
        raise InvalidValueError(
            f"recording {recording.name!r} carries the truth of its row but not where station {station} stood: give "
            "its stations their world_from_station, or leave the truth out (remove truth.npz)"
        )
    frame = scene_from_row @ row.world_from_station[station] @ invert(true_from_station)
    true = truth_of(recording.truth)
    parts = ([_moved(shape, frame) for shape in part] for part in (true.tomatoes, true.stems, true.clutter))
    return _shapes(*(_within_reach(part, settings.reach) for part in parts)).compact()


def _shapes(tomatoes: Sequence[Shape], stems: Sequence[Shape], clutter: Sequence[Shape]) -> Shapes:
    return Shapes(
        tomatoes=tuple(s for s in tomatoes if isinstance(s, Tomato)),
        stems=tuple(s for s in stems if isinstance(s, Stem)),
        clutter=tuple(s for s in clutter if isinstance(s, Sphere | Capsule | Box)),
    )


def _stem_line(stems: Sequence[Shape], recording: Recording) -> float:
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
