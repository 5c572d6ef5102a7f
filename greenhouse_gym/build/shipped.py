"""The shipped banks: their rows, and the function that builds them.

All parts joined are ``default``, and some of its scenes are ``mini``.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

from greenhouse_gym.build.grown import KINDS, PROTOCOLS, WEEKS, RowRecording, build_part
from greenhouse_gym.common.executors import completed
from greenhouse_gym.common.files import exclusive
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.scene import SceneBank
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.manifest import MANIFEST, Split

ROWS, FIRST_SEED = 48, 2000
EXTRA_ROWS: dict[int, Split] = {
    **dict.fromkeys((48, 50, 52), "validation"),  # of the package's own generator, since those above are all of Helios
    **dict.fromkeys((53, 55, 61), "train"),  # cherry and bushy rows, whose targets are the hardest
}
"""Splits of further rows by their number."""

LEFT_OUT = (
    "helios-dense-2011-w07", "helios-bushy-2015-w03", "helios-bushy-2031-w11", "helios-beefsteak-2033-w09",
    "helios-cherry-2045-w09",
)  # fmt: skip
"""Recordings of training rows that are not shipped, so that the package stays below 30 MB."""

MINI_SCENES = (
    "own-cluster-2000-w00-02", "helios-beefsteak-2001-w05-01", "own-cherry-2002-w10-01", "helios-dense-2003-w03-01",
    "own-beefsteak-2004-w08-01", "helios-cherry-2005-w01-00", "helios-cherry-2006-w06-02", "helios-bushy-2007-w11-03",
)  # fmt: skip
"""Scenes of ``mini``, one of each kind of row."""

DESCRIPTION = (
    "Simulated recordings of grown rows, reconstructed: three styles of fruit, plants of two sources, two capture "
    "protocols, weeks 0 to 11. Names contain a row's source, cultivar and seed, and the week; some rows come in two "
    "weeks."
)


def row_recordings() -> Iterator[RowRecording]:
    """Yield the recordings of the shipped bank, ordered so that any first part of them covers all kinds."""
    splits: dict[int, Split] = {
        k: "test" if k % 5 == 4 else "validation" if k % 10 == 7 else "train" for k in range(ROWS)
    }
    for k, split in (splits | EXTRA_ROWS).items():
        block, index = divmod(k, len(KINDS))
        again = index % 4 == block % 4  # rows recorded a second time, three weeks later
        for visit in range(1 + again):
            week, protocol = (5 * k + 3 * visit) % WEEKS, PROTOCOLS[(block + index + visit) % len(PROTOCOLS)]
            recording = RowRecording(FIRST_SEED + k, week, *KINDS[index], protocol, split)
            if recording.name not in LEFT_OUT:
                yield recording


def build_shipped_banks(out: Path, parts: Path, executor: Executor | None = None) -> tuple[SceneBank, SceneBank]:
    """Build ``default`` (every recording) and ``mini`` (`MINI_SCENES`) below a folder.

    Args:
        out: The folder.
        parts: Folder of the parts; existing parts are not built again.
        executor: Executor that builds the parts (`greenhouse_gym.common.executors`); None builds them in this process,
            one after the other.
    """
    with exclusive(parts):
        for _ in completed(partial(build_part, parts=parts, description=DESCRIPTION), row_recordings(), executor):
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
    small = [(scene, split) for scene, split in scenes if scene.name in MINI_SCENES]
    mini = write_bank(out / "mini", small, "mini", "A scene of each kind of row of the default bank, for tests.")
    return default, mini
