"""Give the scenes of the shipped banks a finer, or a coarser, truth of leaves without building the banks anew.

python benchmarks/renew_truth.py --out runs/renewed --entries benchmarks/leaderboard
python benchmarks/renew_truth.py --out runs/rewritten --entries benchmarks/leaderboard --keep-truth

Each recording's row is grown once more, and its leaves are cut as `BuildSettings.leaf_tolerance` has it now. The row is
brought into a scene's frame by the true tomatoes that the scene has already: they are the same in both, to the 0.1 mm
to which a scene file keeps them, and the script stops where they are not. What was reconstructed, seen and certified
stays as it is, so entries of the leaderboard keep the track on which that is all that matters, and lose the others,
which have to be submitted again. A stand that was left out because the coarser leaves reached into the arm's start
stays left out. Takes about half an hour of two cores; what an interrupted run has finished is not made again. With
``--keep-truth``, nothing but the form of the files changes, in a minute, and entries keep all their tracks.
"""

from __future__ import annotations

import argparse
import os
from functools import cache, partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from greenhouse_gym.build.scenes import truth_in_scene
from greenhouse_gym.build.shipped import ROW_LENGTH, SETTINGS, RowRecording, row_recordings
from greenhouse_gym.common.executors import completed, processes
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.crops import PlantRow, grow_row
from greenhouse_gym.evaluation.leaderboard import read_entry
from greenhouse_gym.geometry import Array, pose, transform
from greenhouse_gym.scene import Scene, SceneBank, Shapes
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.truth import start_is_collision_free

KEPT = "reconstruction"
"""The track on which the truth does not matter."""

SAME = 2e-4
"""Metres between a tomato of the grown row and the same one of a scene, at most."""


LEAST = 3
"""Tomatoes by which a frame is found, at least."""


def main() -> None:
    """Renew the scenes of every recording, then write both banks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--banks", type=Path, default=Path("scenes"), help="the folder of default and mini")
    parser.add_argument("--out", type=Path, default=Path("runs/renewed"))
    parser.add_argument("--entries", type=Path, help="the folder of entries that are to go over to the new bank")
    parser.add_argument("--keep-truth", action="store_true", help="write the scenes as they are, as this version does")
    arguments = parser.parse_args()
    default, mini = (SceneBank.open(arguments.banks / name) for name in ("default", "mini"))
    renewed_scenes = None if arguments.keep_truth else arguments.out / "scenes"
    if renewed_scenes is not None:
        with processes(os.cpu_count()) as executor:
            order = sorted(row_recordings(), key=lambda recording: recording.split == "train")
            for name in completed(partial(renew, bank=default, out=renewed_scenes), order, executor):
                print(name, flush=True)
    for bank in (default, mini):
        folder = renewed_scenes or bank.path
        scenes = ((Scene.load(folder / f"{name}.json"), bank.split_of(name)) for name in bank.names())
        after = write_bank(arguments.out / bank.manifest.name, scenes, bank.manifest.name, bank.manifest.description)
        for path in sorted(arguments.entries.glob("*.json")) if arguments.entries else ():
            take_over(path, bank, after)


def renew(recording: RowRecording, bank: SceneBank, out: Path) -> str:
    """Write the scenes of a recording with their truth as it is now; give the recording's name."""
    out.mkdir(parents=True, exist_ok=True)
    names = [name for name in bank.names() if name.rpartition("-")[0] == recording.name]
    if all((out / f"{name}.json").exists() for name in names):
        return recording.name
    row = grow_row(recording.seed, ROW_LENGTH, recording.week, recording.cultivar, source=recording.source)
    for name in names:
        scene = bank.scene(name)
        settings = {**(scene.provenance.settings or {}), "leaf_tolerance": SETTINGS.leaf_tolerance}
        changes = {"provenance": scene.provenance.model_copy(update={"settings": settings})}
        if row.organs:
            changes["truth"] = renewed(row, scene)
        after = scene.model_copy(update=changes)
        if not start_is_collision_free(after, SETTINGS.robot):
            raise SystemExit(f"{name}: the arm would begin in the finer leaves")
        after.save(out / f"{name}.json")
    return recording.name


def renewed(row: PlantRow, scene: Scene) -> Shapes:
    """The truth of a scene with the leaves of the row as they are cut now, tomatoes and stems as they are."""
    assert scene.truth is not None
    clutter = truth_in_scene(row, frame_of(row, scene), SETTINGS).clutter
    return scene.truth.model_copy(update={"clutter": clutter})


def take_over(path: Path, before: SceneBank, after: SceneBank) -> None:
    """Let an entry of the bank before stand for the one after, on the tracks for which the two are the same."""
    entry = read_entry(path)
    if entry.bank_sha256 != before.sha256:
        return
    same_truth = compared(before, after, entry.protocol["split"])
    tracks = {track: rates for track, rates in entry.tracks.items() if same_truth or track == KEPT}
    if tracks:
        machine = {name: value for name, value in entry.machine.items() if name.partition(": ")[0] in tracks}
        changes = {"bank_sha256": after.sha256, "machine": machine, "tracks": tracks}
        write_atomically(path, entry.model_copy(update=changes).model_dump_json() + "\n")


@cache
def compared(before: SceneBank, after: SceneBank, split: str) -> bool:
    """Whether the scenes of a split have the same truth in two banks; nothing else may differ."""
    pairs = [(before.scene(name), after.scene(name)) for name in before.names(split)]
    for old, new in pairs:
        if told(old) != told(new):
            raise SystemExit(
                f"{old.name}: more than the truth has changed; its bank's entries have to be submitted again"
            )
    return all(truth_of(old) == truth_of(new) for old, new in pairs)


def truth_of(scene: Scene) -> str:
    """What is touched on the tracks of the truth."""
    return scene.model_dump_json(include={"truth"})


def told(scene: Scene) -> str:
    """What an agent is told of a scene, and what is touched on the track of the reconstruction."""
    return scene.model_dump_json(exclude={"truth": True, "provenance": {"settings"}})


def frame_of(row: PlantRow, scene: Scene) -> Array:
    """(4, 4) pose of the row's frame in the scene's, by those of its tomatoes that their truss and size tell apart."""
    assert scene.truth is not None
    pairs = []
    for known in scene.truth.tomatoes:
        alike = [t for t in row.tomatoes if t.truss == known.truss and abs(t.radius - known.radius) < SAME]
        if len(alike) == 1:
            pairs.append((alike[0].center, known.center))
    if len(pairs) < LEAST:
        raise SystemExit(f"{scene.name}: {len(pairs)} of its tomatoes are told apart in the row, {LEAST} are needed")
    of_row, of_scene = (np.array(points) for points in zip(*pairs, strict=True))
    turn, _ = Rotation.align_vectors(of_scene - of_scene.mean(axis=0), of_row - of_row.mean(axis=0))
    frame = pose(turn.as_matrix(), of_scene.mean(axis=0) - turn.apply(of_row.mean(axis=0)))
    grown = cKDTree(transform(frame, np.array([t.center for t in row.tomatoes])))
    apart, _ = grown.query([t.center for t in scene.truth.tomatoes])
    if apart.max() > SAME:
        raise SystemExit(f"{scene.name}: its tomatoes are not those of the row, {1000 * apart.max():.2f} mm apart")
    return frame


if __name__ == "__main__":
    main()
