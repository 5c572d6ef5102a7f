"""Recordings to a bank: reconstruct each row, extract its shapes, cut scenes out of it, certify their targets."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pydantic import TypeAdapter

from greenhouse_gym.build.scans import ScannedRow
from greenhouse_gym.build.scenes import BuildSettings, cut_scenes, occupancy_summary, provenance_of
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.common.executors import completed, require_portable
from greenhouse_gym.common.extras import require_extras
from greenhouse_gym.common.files import checked_name, exclusive, parsing, read_bytes, remove_leftovers, write_atomically
from greenhouse_gym.common.progress import say
from greenhouse_gym.errors import FileFormatError, GreenhouseError, InvalidValueError
from greenhouse_gym.planning import certify_targets
from greenhouse_gym.reconstruction import reconstruct_row, settings_for
from greenhouse_gym.scene import Provenance, Scene, SceneBank
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.truth import start_is_collision_free
from greenhouse_gym.shapes import extract_shapes

UNFINISHED, CUT = "unfinished", "scenes.json"
"""Folder, below the bank's, of what an interrupted build knows; and, in it, per row, the scenes without targets."""

_SCENES = TypeAdapter(list[Scene])


def build_bank(
    recordings: Sequence[Recording],
    out: str | Path,
    name: str,
    splits: Sequence[str] | None = None,
    weeks: Sequence[int | None] | None = None,
    settings: BuildSettings | None = None,
    description: str = "",
    on_stage: Callable[[str], None] | None = None,
    known: Sequence[Provenance | None] | None = None,
    executor: Executor | None = None,
) -> SceneBank:
    """Build a bank of scenes from recordings.

    An interrupted build goes on with the station, or the scene, at which it stopped: what is not finished lies in the
    folder ``unfinished`` until the manifest is written, last. What was made of other images, with other settings or by
    another version is made anew.

    Args:
        recordings: Of one row each, recordings or a `greenhouse_gym.scans.ScannedRow`; their names become the rows'.
        out: The bank's folder.
        name: The bank's name.
        splits: Split of each row; by default two thirds train, the rest validation and test in turn.
        weeks: Growth week of each row, where known.
        settings: All settings.
        description: A sentence on where the bank comes from.
        on_stage: Told what is being done, row by row.
        known: For each recording the row, its style and its source, where they are known. Recordings of one row, in
            other weeks, name the same row, and go into the same split.
        executor: Where rows are reconstructed and scenes certified; None does it here. Only this process writes files,
            the same ones, but with an executor a row that is interrupted begins anew, not at its last station.

    Raises:
        InvalidValueError: No recordings, two of one name, one that cannot be a file's, lists of different lengths, a
            row in two splits, or one in whose true plants the arm would begin at all stands.
        FileWriteError: The folder cannot be written, or another process is building in it; told before any work.
        MissingDependencyError: OMPL, which certifies the targets, is not installed.
        ReconstructionError: A recording could not be turned into a row.
        WorkerLostError: A process of the executor died; what was built stays, and the same call goes on with it.
    """
    settings = settings or BuildSettings()
    names = [checked_name("a recording to build of", recording.name) for recording in recordings]
    splits = default_splits(len(recordings)) if splits is None else splits
    weeks = [None] * len(recordings) if weeks is None else weeks
    known = [None] * len(recordings) if known is None else known
    same_length = len(names) == len(splits) == len(weeks) == len(known)
    if not recordings or len(set(names)) != len(names) or not same_length:
        raise InvalidValueError(
            f"expected recordings with different names, each with a split and a week; got {names}, {splits}, {weeks}"
        )
    require_extras("reconstruct", "plan")
    report = on_stage or say
    folder = Path(out)
    rows = [
        _Row(
            recording, week, facts, replace(settings, reconstruction=settings.reconstruction or settings_for(recording))
        )
        for recording, week, facts in zip(recordings, weeks, known, strict=True)
    ]
    for recording in recordings:
        require_portable(executor, f"recording {recording.name!r}", recording)
    with exclusive(folder):
        scenes = _certified_scenes(folder, rows, report, executor)
        bank = write_bank(
            folder,
            ((Scene.load(path), split) for name, split in zip(names, splits, strict=True) for path in scenes[name]),
            name,
            description,
        )
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
        remove_leftovers(folder, ".json")
    return bank


@dataclass(frozen=True)
class _Row:
    """A recording on its way to scenes; it can travel to another process, unless it has notes and a voice.

    Attributes:
        recording: The recording.
        week: Its growth week, if known.
        known: Its row, the row's style and source, where they are known.
        settings: All settings.
        origin: Where its scenes come from.
        notes: Folder for what is known of an unfinished walk.
        report: Told what is being done.
    """

    recording: Recording
    week: int | None
    known: Provenance | None
    settings: BuildSettings
    origin: Provenance | None = None
    notes: Path | None = None
    report: Callable[[str], None] | None = None

    @property
    def name(self) -> str:
        return self.recording.name


def _certified_scenes(
    folder: Path, rows: Sequence[_Row], report: Callable[[str], None], executor: Executor | None
) -> dict[str, list[Path]]:
    """The files of the certified scenes of each recording, by its name and in their order."""
    origins = dict(completed(_origin, rows, executor))
    notes = {row.name: folder / UNFINISHED / row.name for row in rows}
    scenes: dict[str, list[Path]] = {}
    built = _finished_bank(folder)
    for row in rows:
        if finished := _of_finished_bank(built, origins[row.name]):
            report(f"{row.name}: {len(finished)} scenes already built")
            scenes[row.name] = [_file(folder, scene) for scene in finished]
    unfinished = [replace(row, origin=origins[row.name]) for row in rows if row.name not in scenes]
    uncut = [row for row in unfinished if _cut_before(notes[row.name] / CUT, origins[row.name]) is None]
    if executor is None:
        uncut = [replace(row, notes=notes[row.name], report=report) for row in uncut]
    settings = {row.name: row.settings for row in rows}
    for name, cut in completed(_cut, uncut, executor):
        standing = _standing(name, cut, settings[name], report)
        write_atomically(notes[name] / CUT, _SCENES.dump_json(standing))
        for scene in standing:
            report(occupancy_summary(scene, settings[name]))

    def uncertified() -> Iterator[tuple[Scene, BuildSettings]]:
        for row in unfinished:
            cut = _cut_before(notes[row.name] / CUT, origins[row.name])
            assert cut is not None  # it was written above, or found
            report(f"{row.name}: certifying the targets of {len(cut)} scenes")
            scenes[row.name] = [_file(folder, scene) for scene in cut]
            yield from ((scene, row.settings) for scene in cut if not _is_certified(folder, scene))

    for scene in completed(_certified, uncertified(), executor):
        scene.save(_file(folder, scene))
    return scenes


def _origin(row: _Row) -> tuple[str, Provenance]:
    return row.name, provenance_of(row.recording, row.week, row.settings, row.known)


def _cut(row: _Row) -> tuple[str, list[Scene]]:
    """The scenes of a row, without targets."""
    report = row.report or (lambda text: None)
    if isinstance(row.recording, ScannedRow):
        for note in row.recording.scan.notes:
            report(f"{row.name}: {note}")
        found = row.recording.shapes
        return row.name, cut_scenes(row.recording.row, found, row.recording, row.week, row.settings, row.origin)
    report(f"{row.name}: reconstructing {len(row.recording)} stations")
    cloud = reconstruct_row(row.recording, row.settings.reconstruction, folder=row.notes)
    report(f"{row.name}: extracting shapes from {len(cloud)} points")
    shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals, row.settings.shapes)
    return row.name, cut_scenes(cloud, shapes, row.recording, row.week, row.settings, row.origin)


def _standing(name: str, cut: Sequence[Scene], settings: BuildSettings, report: Callable[[str], None]) -> list[Scene]:
    """The scenes of a recording at whose stands an arm can be put up: it does not begin in the true plants.

    Raises:
        InvalidValueError: There is none.
    """
    free = [scene for scene in cut if start_is_collision_free(scene, settings.robot)]
    if not free:
        raise InvalidValueError(
            f"recording {name!r}: at all {len(cut)} stands the arm would begin in the plants of its truth; move them "
            f"with BuildSettings.spacing or stem_distance, now {settings.stem_distance:g} m"
        )
    if len(free) < len(cut):
        report(f"{name}: {len(cut) - len(free)} of {len(cut)} stands left out, where the arm would begin in plants")
    return free


def _certified(piece: tuple[Scene, BuildSettings]) -> Scene:
    """A scene with its targets."""
    scene, settings = piece
    targets = certify_targets(
        scene, settings.robot, max_targets=settings.max_targets, min_radius=settings.min_target_radius
    )
    return scene.model_copy(update={"targets": targets})


def _is_certified(folder: Path, scene: Scene) -> bool:
    """Whether an interrupted build left the scene with its targets in the folder."""
    try:
        found = Scene.load(_file(folder, scene))
    except FileFormatError:
        return False
    same = found.model_copy(update={"targets": ()}).model_dump_json() == scene.model_dump_json()
    return bool(found.targets) and same


def _file(folder: Path, scene: Scene) -> Path:
    return folder / f"{scene.name}.json"


def _cut_before(path: Path, origin: Provenance) -> list[Scene] | None:
    """Scenes that an interrupted build cut out of the same row in the same way; None where there are none."""
    try:
        with parsing(path, "list of scenes"):
            found = _SCENES.validate_json(read_bytes(path, "scene"))
    except FileFormatError:
        return None
    return found if all(_same(scene, origin) for scene in found) else None


def _finished_bank(folder: Path) -> dict[str, list[Callable[[], Scene]]]:
    """What gives the scenes of each row of the bank in the folder; empty where there is none."""
    try:
        bank = SceneBank.open(folder)
    except GreenhouseError:
        return {}
    found: dict[str, list[Callable[[], Scene]]] = {}
    for entry in bank.manifest.scenes:
        found.setdefault(entry.row, []).append(partial(bank.scene, entry.name))
    return found


def _of_finished_bank(bank: dict[str, list[Callable[[], Scene]]], origin: Provenance) -> list[Scene]:
    """The recording's scenes in a bank, if they were made in the same way."""
    try:
        of_row = [scene() for scene in bank.get(origin.row, ())]
    except GreenhouseError:
        return []
    found = [scene for scene in of_row if scene.provenance.recording == origin.recording]
    return found if all(_same(scene, origin) for scene in found) else []


def _same(scene: Scene, origin: Provenance) -> bool:
    """Whether a scene comes from there, wherever along the row it stands."""
    return scene.provenance.model_copy(update={"station": None}) == origin


def default_splits(rows: int) -> list[str]:
    """Two thirds of the rows for training, the others for validation and test in turn."""
    train = max(1, round(2 * rows / 3))
    return ["train"] * train + ["validation" if k % 2 == 0 else "test" for k in range(rows - train)]
