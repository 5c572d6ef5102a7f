"""Build a bank from recordings: reconstruct each row, extract its shapes, cut scenes and certify their targets."""

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
from greenhouse_gym.common.executors import completed, portable
from greenhouse_gym.common.extras import require_extras
from greenhouse_gym.common.files import checked_name, exclusive, parsing, read_bytes, write_atomically
from greenhouse_gym.common.progress import say
from greenhouse_gym.errors import FileFormatError, GreenhouseError, InvalidValueError, NoPlacementError
from greenhouse_gym.planning import certify_targets
from greenhouse_gym.planning.rated_banks import with_brush_certificates
from greenhouse_gym.reconstruction import reconstruct_row, settings_for
from greenhouse_gym.scene import Provenance, Scene, SceneBank
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.truth import start_is_collision_free
from greenhouse_gym.shapes import extract_shapes

UNFINISHED, CUT = "unfinished", "scenes.json"
"""Subfolder with the state of an interrupted build, and the file with the scenes of a row before certification."""

_SCENES = TypeAdapter(list[Scene])


def build_bank(
    recordings: Sequence[Recording],
    out: str | Path,
    name: str,
    splits: Sequence[str] | None = None,
    weeks: Sequence[int | None] | None = None,
    settings: BuildSettings | None = None,
    description: str = "",
    on_progress: Callable[[str], None] | None = None,
    known: Sequence[Provenance | None] | None = None,
    executor: Executor | None = None,
) -> SceneBank:
    """Build a bank of scenes from recordings.

    Resumes an interrupted build at the station or scene where it stopped: intermediate results stay in the folder
    ``unfinished`` until the manifest, the last file, is written. Results of other images, settings or versions are
    computed again.

    Args:
        recordings: Recordings of one row each, or a `greenhouse_gym.build.scans.ScannedRow`; rows take their names.
        out: The bank's folder.
        name: The bank's name.
        splits: Split of each row; by default two thirds train, the rest validation and test in turn.
        weeks: Growth week of each row, if known.
        settings: All settings.
        description: A sentence on where the bank comes from.
        on_progress: Called with a line on the progress of each row.
        known: For each recording the row, its style and its source, if known. Recordings of one row in several weeks
            name the same row and belong to the same split.
        executor: Executor that reconstructs rows and certifies scenes; None runs in this process. Only this process
            writes files, with equal content. With an executor, an interrupted row starts again at its first station.

    Raises:
        InvalidValueError: There are no recordings, two share a name, a name is no safe file name, lists differ in
            length, or a row is in two splits.
        NoPlacementError: The arm would start inside true plants at all placements of a row.
        FileWriteError: The folder cannot be written, or another process is building in it; raised before any work.
        MissingDependencyError: OMPL, which certifies the targets, is not installed.
        ReconstructionError: A recording could not be turned into a row.
        WorkerLostError: A process of the executor died; finished results stay, and the same call resumes the build.
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
    report = on_progress or say
    folder = Path(out)
    rows = [
        _Row(
            recording, week, facts, replace(settings, reconstruction=settings.reconstruction or settings_for(recording))
        )
        for recording, week, facts in zip(recordings, weeks, known, strict=True)
    ]
    for recording in recordings:
        portable(executor, f"recording {recording.name!r}", recording)
    with exclusive(folder):
        scenes = _certified_scenes(folder, rows, report, executor)
        bank = write_bank(
            folder,
            ((Scene.load(path), split) for name, split in zip(names, splits, strict=True) for path in scenes[name]),
            name,
            description,
        )
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
    return bank


@dataclass(frozen=True)
class _Row:
    """A recording from which scenes are built; it can be sent to another process if it has no folder and no report.

    Attributes:
        recording: The recording.
        week: Its growth week, if known.
        known: Its row, the row's style and source, if known.
        settings: All settings.
        origin: Provenance of its scenes.
        folder: Folder for intermediate results of the station registration.
        report: Called with a line on the progress.
    """

    recording: Recording
    week: int | None
    known: Provenance | None
    settings: BuildSettings
    origin: Provenance | None = None
    folder: Path | None = None
    report: Callable[[str], None] | None = None

    @property
    def name(self) -> str:
        return self.recording.name


def _certified_scenes(
    folder: Path, rows: Sequence[_Row], report: Callable[[str], None], executor: Executor | None
) -> dict[str, list[Path]]:
    """Certify all scenes and return their files by the name of the recording, in order."""
    origins = dict(completed(_origin, rows, executor))
    folders = {row.name: folder / UNFINISHED / row.name for row in rows}
    scenes: dict[str, list[Path]] = {}
    built = _finished_bank(folder)
    for row in rows:
        if finished := _of_finished_bank(built, origins[row.name]):
            report(f"{row.name}: {len(finished)} scenes already built")
            scenes[row.name] = [_file(folder, scene) for scene in finished]
    unfinished = [replace(row, origin=origins[row.name]) for row in rows if row.name not in scenes]
    uncut = [row for row in unfinished if _cut_before(folders[row.name] / CUT, origins[row.name]) is None]
    if executor is None:
        uncut = [replace(row, folder=folders[row.name], report=report) for row in uncut]
    settings = {row.name: row.settings for row in rows}
    for name, cut in completed(_cut, uncut, executor):
        placed = _collision_free(name, cut, settings[name], report)
        write_atomically(folders[name] / CUT, _SCENES.dump_json(placed))
        for scene in placed:
            report(occupancy_summary(scene, settings[name]))

    def uncertified() -> Iterator[tuple[Scene, BuildSettings]]:
        for row in unfinished:
            cut = _cut_before(folders[row.name] / CUT, origins[row.name])
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
    """Cut the scenes of a row, without targets."""
    report = row.report or (lambda text: None)
    if isinstance(row.recording, ScannedRow):
        for note in row.recording.scan.notes:
            report(f"{row.name}: {note}")
        found = row.recording.shapes
        return row.name, cut_scenes(row.recording.row, found, row.recording, row.week, row.settings, row.origin)
    report(f"{row.name}: reconstructing {len(row.recording)} stations")
    cloud = reconstruct_row(row.recording, row.settings.reconstruction, folder=row.folder)
    report(f"{row.name}: extracting shapes from {len(cloud)} points")
    shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals, row.settings.shapes)
    return row.name, cut_scenes(cloud, shapes, row.recording, row.week, row.settings, row.origin)


def _collision_free(
    name: str, cut: Sequence[Scene], settings: BuildSettings, report: Callable[[str], None]
) -> list[Scene]:
    """Return the scenes of a recording in which the arm does not start inside the true plants.

    Raises:
        NoPlacementError: There are none.
    """
    free = [scene for scene in cut if start_is_collision_free(scene, settings.robot)]
    if not free:
        raise NoPlacementError(
            f"recording {name!r}: at all {len(cut)} placements the arm would start inside the true plants; move them "
            f"with BuildSettings.spacing or stem_distance, now {settings.stem_distance:g} m"
        )
    if len(free) < len(cut):
        report(
            f"{name}: {len(cut) - len(free)} of {len(cut)} placements left out, where the arm would start inside plants"
        )
    return free


def _certified(piece: tuple[Scene, BuildSettings]) -> Scene:
    """Return a scene with its targets."""
    scene, settings = piece
    targets = certify_targets(
        scene, settings.robot, max_targets=settings.max_targets, min_radius=settings.min_target_radius
    )
    return with_brush_certificates(scene.model_copy(update={"targets": targets}), settings.robot)


def _is_certified(folder: Path, scene: Scene) -> bool:
    """Return whether an interrupted build has already written the scene with its targets."""
    try:
        found = Scene.load(_file(folder, scene))
    except FileFormatError:
        return False
    same = found.model_copy(update={"targets": ()}).model_dump_json() == scene.model_dump_json()
    return bool(found.targets) and same


def _file(folder: Path, scene: Scene) -> Path:
    return folder / f"{scene.name}.json"


def _cut_before(path: Path, origin: Provenance) -> list[Scene] | None:
    """Return the scenes that an interrupted build cut from the same row with the same settings, or None."""
    try:
        with parsing(path, "list of scenes"):
            found = _SCENES.validate_json(read_bytes(path, "scene"))
    except FileFormatError:
        return None
    return found if all(_same(scene, origin) for scene in found) else None


def _finished_bank(folder: Path) -> dict[str, list[Callable[[], Scene]]]:
    """Return loaders of the scenes of each row of the bank in the folder; empty without a bank."""
    try:
        bank = SceneBank.open(folder)
    except GreenhouseError:
        return {}
    found: dict[str, list[Callable[[], Scene]]] = {}
    for entry in bank.manifest.scenes:
        found.setdefault(entry.row, []).append(partial(bank.scene, entry.name))
    return found


def _of_finished_bank(bank: dict[str, list[Callable[[], Scene]]], origin: Provenance) -> list[Scene]:
    """Return the recording's scenes in a bank if they have the same provenance, else an empty list."""
    try:
        of_row = [scene() for scene in bank.get(origin.row, ())]
    except GreenhouseError:
        return []
    found = [scene for scene in of_row if scene.provenance.recording == origin.recording]
    return found if all(_same(scene, origin) for scene in found) else []


def _same(scene: Scene, origin: Provenance) -> bool:
    """Return whether a scene has this provenance, at any station."""
    return scene.provenance.model_copy(update={"station": None}) == origin


def default_splits(rows: int) -> list[str]:
    """Assign two thirds of the rows to training and the others alternately to validation and test."""
    train = max(1, round(2 * rows / 3))
    return ["train"] * train + ["validation" if k % 2 == 0 else "test" for k in range(rows - train)]
