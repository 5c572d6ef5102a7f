"""The banks that ship with the package: which rows they are made of, and the one function that builds them.

Every recording becomes a bank of its own, a part. All parts joined are ``default``, and some scenes of it are ``mini``.
What an interrupted build has finished is not made again.
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
"""Four stands on a row of this length; a cherry row would have more targets than all others together."""

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
"""Source, cultivar and style of fruit of the rows, in turn: more than half of them hard to reach into."""

PROTOCOLS = ("paper", "upright-back")
"""How rows are photographed: in turn, so that each kind is seen both ways, and a row of two weeks as well."""

DESCRIPTION = (
    "Simulated recordings of grown rows, reconstructed: three styles of fruit, plants of two sources, two capture "
    "protocols, weeks 0 to 11. Names tell a row's source, cultivar and seed, and the week; some rows come in two weeks."
)


@dataclass(frozen=True)
class Shot:
    """One recording of a row.

    Attributes:
        seed: Seed of the row.
        week: Growth week.
        source: Where the plants come from.
        cultivar: As `grow_row` takes it for a style.
        style: Style of the fruit.
        protocol: How the row is photographed.
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
        """Name of the row, the same in all weeks."""
        return f"{self.source}-{self.cultivar}-{self.seed}"

    @property
    def name(self) -> str:
        """Name of the recording."""
        return f"{self.row}-w{self.week:02d}"

    def recording(self) -> Recording:
        """The recording, simulated."""
        row = grow_row(self.seed, ROW_LENGTH, self.week, self.cultivar, source=self.source)
        # another walk and other noise in every week
        return replace(simulate_protocol(row, 100 * self.seed + self.week, self.protocol), name=self.name)


def shots() -> Iterator[Shot]:
    """The recordings of the shipped bank, in an order in which any first part of them holds something of everything."""
    for k in range(ROWS):
        block, place = divmod(k, len(KINDS))
        split = "test" if k % 5 == 4 else "validation" if k % 10 == 7 else "train"
        again = place % 4 == block % 4  # rows recorded a second time, three weeks later
        for visit in range(1 + again):
            week, protocol = (5 * k + 3 * visit) % WEEKS, PROTOCOLS[(block + place + visit) % len(PROTOCOLS)]
            yield Shot(FIRST_SEED + k, week, *KINDS[place], protocol, split)


def build_part(shot: Shot, parts: Path) -> Path:
    """Build the bank of one recording in a folder of its own below ``parts``, unless it is there; give that folder."""
    known = Provenance(row=shot.row, style=shot.style, source=shot.source)
    folder = parts / shot.name
    build_bank([shot.recording()], folder, shot.name, [shot.split], [shot.week], SETTINGS, DESCRIPTION, known=[known])
    return folder


def build_shipped_banks(out: Path, parts: Path, executor: Executor | None = None) -> tuple[SceneBank, SceneBank]:
    """Build ``default`` (every recording) and ``mini`` (a scene of each kind of row) below a folder.

    Args:
        out: The folder.
        parts: Folder of the parts; those that are in it already are not built again.
        executor: Where the recordings are worked on, such as `greenhouse_gym.parallel.processes` gives; here, one after
            the other, when left out.
    """
    with exclusive(parts):
        for _ in completed(partial(build_part, parts=parts), shots(), executor):
            pass
        return join_parts(parts, out)


def join_parts(parts: Path, out: Path) -> tuple[SceneBank, SceneBank]:
    """Join the parts that are finished, in their usual order, to ``default`` and ``mini`` below a folder.

    Raises:
        FileFormatError: No part is finished; the banks in the folder stay as they are.
    """
    folders = {shot: parts / shot.name for shot in shots()}
    banks = {shot: SceneBank.open(folder) for shot, folder in folders.items() if (folder / MANIFEST).exists()}
    if not banks:
        raise FileFormatError(parts, "holds no finished part of the shipped banks")
    scenes = [(scene, shot.split) for shot, bank in banks.items() for scene in bank]
    default = write_bank(out / "default", scenes, "default", DESCRIPTION)
    # of a row's weeks the first, and of its scenes the one with most to reach for
    first = {shot.row: (max(bank, key=_reachable), shot.split) for shot, bank in reversed(banks.items())}
    small = list(reversed(first.values()))[: len(KINDS)]
    mini = write_bank(out / "mini", small, "mini", "A scene of each kind of row of the default bank, for tests.")
    return default, mini


def _reachable(scene: Scene) -> int:
    return sum(target.difficulty != "unreachable" for target in scene.targets)
