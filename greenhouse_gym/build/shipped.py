"""The shipped banks: their rows, and the function that builds them.

Each recording becomes a bank of its own, a part. All parts joined are ``default``, and some of its scenes are ``mini``.
An interrupted build keeps its finished parts.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from greenhouse_gym.build.bank_builder import build_bank
from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.capture import Recording, simulate_protocol
from greenhouse_gym.common.executors import completed
from greenhouse_gym.common.files import exclusive
from greenhouse_gym.crops import grow_row
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.scene import Provenance, Scene, SceneBank
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.manifest import MANIFEST

ROW_LENGTH = 1.0  # m
ROWS, FIRST_SEED, WEEKS = 48, 2000, 12

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

DESCRIPTION = (
    "Simulated recordings of grown rows, reconstructed: three styles of fruit, plants of two sources, two capture "
    "protocols, weeks 0 to 11. Names contain a row's source, cultivar and seed, and the week; some rows come in two "
    "weeks."
)


@dataclass(frozen=True)
class RowRecording:
    """One recording of a row of the shipped banks.

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
    split: str

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


def row_recordings() -> Iterator[RowRecording]:
    """Yield the recordings of the shipped bank, ordered so that any first part of them covers all kinds."""
    for k in range(ROWS):
        block, index = divmod(k, len(KINDS))
        split = "test" if k % 5 == 4 else "validation" if k % 10 == 7 else "train"
        again = index % 4 == block % 4  # rows recorded a second time, three weeks later
        for visit in range(1 + again):
            week, protocol = (5 * k + 3 * visit) % WEEKS, PROTOCOLS[(block + index + visit) % len(PROTOCOLS)]
            yield RowRecording(FIRST_SEED + k, week, *KINDS[index], protocol, split)


def build_part(recording: RowRecording, parts: Path) -> Path:
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
        DESCRIPTION,
        known=[known],
    )
    return folder


def build_shipped_banks(out: Path, parts: Path, executor: Executor | None = None) -> tuple[SceneBank, SceneBank]:
    """Build ``default`` (every recording) and ``mini`` (a scene of each kind of row) below a folder.

    Args:
        out: The folder.
        parts: Folder of the parts; existing parts are not built again.
        executor: Executor that builds the parts (`greenhouse_gym.common.executors`); None builds them in this process,
            one after the other.
    """
    with exclusive(parts):
        for _ in completed(partial(build_part, parts=parts), row_recordings(), executor):
            pass
        return join_parts(parts, out)


def join_parts(parts: Path, out: Path) -> tuple[SceneBank, SceneBank]:
    """Join the finished parts in their usual order to ``default`` and ``mini`` below a folder.

    Raises:
        FileFormatError: No part is finished; the banks in the folder stay as they are.
    """
    folders = {recording: parts / recording.name for recording in row_recordings()}
    banks = {recording: SceneBank.open(folder) for recording, folder in folders.items() if (folder / MANIFEST).exists()}
    if not banks:
        raise FileFormatError(parts, "holds no finished part of the shipped banks")
    scenes = [(scene, recording.split) for recording, bank in banks.items() for scene in bank]
    default = write_bank(out / "default", scenes, "default", DESCRIPTION)
    # the first week of each row, and its scene with most reachable targets
    first = {recording.row: (max(bank, key=_reachable), recording.split) for recording, bank in reversed(banks.items())}
    small = list(reversed(first.values()))[: len(KINDS)]
    mini = write_bank(out / "mini", small, "mini", "A scene of each kind of row of the default bank, for tests.")
    return default, mini


def _reachable(scene: Scene) -> int:
    return sum(target.difficulty != "unreachable" for target in scene.targets)
