"""Recordings to a bank: reconstruct each row, extract its shapes, cut scenes out of it, certify their targets."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from pydantic import TypeAdapter

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.cutting import BuildSettings, cut_scenes, provenance_of, what_was_seen
from greenhouse_gym.errors import FileFormatError, GreenhouseError, InvalidValueError
from greenhouse_gym.extras import require_extras
from greenhouse_gym.paths import checked_name, exclusive, parsing, read_bytes, write_atomically
from greenhouse_gym.planning import certify_targets
from greenhouse_gym.progress import CONSOLE
from greenhouse_gym.reconstruction import reconstruct_row, settings_for
from greenhouse_gym.scene import Provenance, Scene, SceneBank
from greenhouse_gym.scene.bank import write_bank
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
) -> SceneBank:
    """Build a bank of scenes from recordings.

    An interrupted build goes on with the station, or the scene, at which it stopped: what is not finished lies in the
    folder ``unfinished`` until the manifest is written, last. What was made of other images, with other settings or by
    another version is made anew.

    Args:
        recordings: Of one row each; their names become the rows' names.
        out: The bank's folder.
        name: The bank's name.
        splits: Split of each row; by default two thirds train, the rest validation and test in turn.
        weeks: Growth week of each row, where known.
        settings: All settings.
        description: A sentence on where the bank comes from.
        on_stage: Told what is being done, row by row.
        known: Of each recording the row, its style and its source, where they are known. Recordings of one row, in
            other weeks, name the same row, and go into the same split.

    Raises:
        InvalidValueError: No recordings, two of one name, one that cannot be a file's, lists of different lengths, or a
            row in two splits.
        FileWriteError: The folder cannot be written, or another process is building in it; told before any work.
        MissingDependencyError: OMPL, which certifies the targets, is not installed.
        ReconstructionError: A recording could not be turned into a row.
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
    report = on_stage or (lambda text: CONSOLE.print(text, highlight=False, markup=False))
    folder = Path(out)
    scenes: list[tuple[Scene, str]] = []
    with exclusive(folder):
        for recording, split, week, facts in zip(recordings, splits, weeks, known, strict=True):
            fitted = replace(settings, reconstruction=settings.reconstruction or settings_for(recording))
            made = _row_of_scenes(folder, recording, week, facts, fitted, report)
            scenes += [(scene, split) for scene in made]
        bank = write_bank(folder, scenes, name, description)
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
    return bank


def _row_of_scenes(
    folder: Path,
    recording: Recording,
    week: int | None,
    known: Provenance | None,
    settings: BuildSettings,
    report: Callable[[str], None],
) -> Sequence[Scene]:
    """The certified scenes of a recording, each saved in the bank's folder."""
    origin = provenance_of(recording, week, settings, known)
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
            report(what_was_seen(scene, settings))
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
    """The recording's scenes in the bank in the folder, if there is one and they were made in the same way."""
    try:
        bank = SceneBank.open(folder)
        of_row = [bank.scene(entry.name) for entry in bank.manifest.scenes if entry.row == origin.row]
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
