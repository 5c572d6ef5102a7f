"""Banks of grown rows: each recording becomes a bank of its own, a part, and the parts are joined.

An interrupted build keeps its finished parts.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from greenhouse_gym.build.bank_builder import UNFINISHED, build_bank
from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.capture import Recording, simulate_protocol
from greenhouse_gym.common.executors import completed
from greenhouse_gym.common.extras import require_extras
from greenhouse_gym.common.files import exclusive
from greenhouse_gym.common.progress import report
from greenhouse_gym.crops import grow_row
from greenhouse_gym.errors import (
    InvalidValueError,
    NoPlacementError,
    ReconstructionError,
    check_whole,
    require_seed,
)
from greenhouse_gym.scene import Provenance, SceneBank
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.manifest import MANIFEST, Split

ROW_LENGTH = 1.0  # m
WEEKS = 12

SETTINGS = BuildSettings(spacing=0.2, max_targets=72)
"""Four placements per row. Without a limit, a cherry row would have more targets than all others together."""

KINDS = (
    ("own", "cluster", "cluster"),
    ("helios", "beefsteak", "beefsteak"),
    ("own", "cherry", "cherry"),
    ("helios", "dense", "cluster"),
    ("own", "beefsteak", "beefsteak"),
    ("helios", "cherry", "cherry"),
    ("helios", "cherry", "cherry"),
    ("helios", "bushy", "cluster"),
)
"""Source, cultivar and fruit style of the rows in turn; more than half of them are hard to reach into."""

PROTOCOLS = ("paper", "upright-back")
"""Capture protocols in turn, so that each kind of row, and each row with two weeks, is photographed by both."""

FIRST_TRAINING_SEED = 10_000
"""Smaller seeds belong to rows that are shipped or held out."""


@dataclass(frozen=True)
class RowRecording:
    """One recording of a grown row.

    Attributes:
        seed: Seed of the row.
        week: Growth week.
        source: Source of the plants.
        cultivar: Style as `greenhouse_gym.crops.grow_row` takes it.
        style: Fruit style.
        protocol: Capture protocol.
        split: Split of the row.
    """

    seed: int
    week: int
    source: str
    cultivar: str
    style: str
    protocol: str
    split: Split

    @property
    def row(self) -> str:
        """Name of the row, equal in all weeks."""
        return f"{self.source}-{self.cultivar}-{self.seed}"

    @property
    def name(self) -> str:
        """Name of the recording."""
        return f"{self.row}-w{self.week:02d}"

    def simulate(self) -> Recording:
        """Simulate the recording."""
        row = grow_row(self.seed, ROW_LENGTH, self.week, self.cultivar, source=self.source)
        # another walk and other noise each week
        return replace(simulate_protocol(row, 100 * self.seed + self.week, self.protocol), name=self.name)


def training_recordings(
    count: int, seed: int = FIRST_TRAINING_SEED, source: str | None = None
) -> Iterator[RowRecording]:
    """Yield recordings of training rows that are in no shipped bank: all kinds, weeks and protocols in turn.

    Args:
        count: Number of rows, each recorded once.
        seed: Seed of the first row, 10,000 or more; the following rows have the following seeds.
        source: Only plants of this source, ``own`` or ``helios``; None for both.

    Raises:
        InvalidValueError: A value is out of range, or nothing is grown by the source.
    """
    kinds = [kind for kind in KINDS if source in (None, kind[0])]
    if not kinds:
        raise InvalidValueError(f"source must be one of {', '.join(sorted({k[0] for k in KINDS}))}, got {source!r}")
    if require_seed(seed) < FIRST_TRAINING_SEED:
        raise InvalidValueError(
            f"seed must be {FIRST_TRAINING_SEED} or more: smaller ones are of shipped and held-out rows, got {seed}"
        )
    for k in range(seed, seed + check_whole("count", count, 1)):
        block, index = divmod(k, len(kinds))
        yield RowRecording(
            k,
            5 * (k - FIRST_TRAINING_SEED) % WEEKS,
            *kinds[index],
            PROTOCOLS[(block + index) % len(PROTOCOLS)],
            "train",
        )


def build_part(recording: RowRecording, parts: Path, description: str) -> Path:
    """Build the bank of one recording in its own folder below ``parts``, unless it exists; return that folder."""
    known = Provenance(row=recording.row, style=recording.style, source=recording.source)
    folder = parts / recording.name
    build_bank(
        [recording.simulate()],
        folder,
        recording.name,
        [recording.split],
        [recording.week],
        SETTINGS,
        description,
        known=[known],
    )
    return folder


def build_training_bank(
    out: str | Path,
    recordings: Sequence[RowRecording],
    executor: Executor | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> SceneBank:
    """Build the bank of recordings of grown rows; resumes an interrupted build at the first row that it lacks.

    A row that leaves the arm no room, or that cannot be reconstructed, is left out with a message. A finished bank of
    the same recordings is returned as it is.

    Args:
        out: The bank's folder.
        recordings: Recordings, as of `training_recordings`.
        executor: Executor that builds the parts (`greenhouse_gym.common.executors`); None builds them in this process.
        on_progress: Called with the number of finished rows.

    Raises:
        InvalidValueError: There are no recordings, the folder holds another bank, or no row is left.
        FileWriteError: The folder cannot be written, or another process is building in it.
        MissingDependencyError: OMPL, which certifies the targets, or Helios is not installed.
    """
    if not recordings:
        raise InvalidValueError("expected recordings of rows to build a bank of, got none")
    require_extras("reconstruct", "plan")
    first, last = recordings[0].name, recordings[-1].name
    described = f"Grown training rows, reconstructed: {len(recordings)} recordings, {first} to {last}."
    folder = Path(out)
    parts = folder / UNFINISHED
    with exclusive(folder):
        if (folder / MANIFEST).exists() and not parts.exists():
            return _same_bank(folder, described)
        build = partial(_part_or_none, parts=parts)
        built: set[Path | None] = set()
        for done, part in enumerate(completed(build, recordings, executor), start=1):
            built.add(part)
            on_progress(done)
        usable = [row for row in recordings if parts / row.name in built]
        scenes = [(scene, row.split) for row in usable for scene in SceneBank.open(parts / row.name)]
        if not scenes:
            raise InvalidValueError(f"{folder}: none of the {len(recordings)} rows could be used; the messages say why")
        bank = write_bank(folder, scenes, folder.resolve().name, described)
    shutil.rmtree(parts)
    return bank


def _same_bank(folder: Path, described: str) -> SceneBank:
    """Return the finished bank in a folder.

    Raises:
        InvalidValueError: It is described otherwise.
    """
    bank = SceneBank.open(folder)
    if bank.manifest.description != described:
        raise InvalidValueError(
            f"{folder} holds another bank ({bank.manifest.description!r}); choose a new folder for {described!r}"
        )
    return bank


def _part_or_none(recording: RowRecording, parts: Path) -> Path | None:
    """Build the bank of one recording; None, with a message, if its row cannot be used."""
    try:
        return build_part(recording, parts, "A training row, grown, photographed and reconstructed.")
    except (NoPlacementError, ReconstructionError) as error:
        report(f"{recording.name} is left out: {error}")
        return None
