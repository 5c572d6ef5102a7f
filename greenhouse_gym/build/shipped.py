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
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.manifest import MANIFEST, Split

ROWS, FIRST_SEED = 48, 2000

DESCRIPTION = (
    "Simulated recordings of grown rows, reconstructed: three styles of fruit, plants of two sources, two capture "
    "protocols, weeks 0 to 11. Names contain a row's source, cultivar and seed, and the week; some rows come in two "
    "weeks."
)


def row_recordings() -> Iterator[RowRecording]:
    """Yield the recordings of the shipped bank, ordered so that any first part of them covers all kinds."""
    for k in range(ROWS):
        block, index = divmod(k, len(KINDS))
        split: Split = "test" if k % 5 == 4 else "validation" if k % 10 == 7 else "train"
        again = index % 4 == block % 4  # rows recorded a second time, three weeks later
        for visit in range(1 + again):
            week, protocol = (5 * k + 3 * visit) % WEEKS, PROTOCOLS[(block + index + visit) % len(PROTOCOLS)]
            yield RowRecording(FIRST_SEED + k, week, *KINDS[index], protocol, split)


def build_shipped_banks(out: Path, parts: Path, executor: Executor | None = None) -> tuple[SceneBank, SceneBank]:
    """Build ``default`` (every recording) and ``mini`` (a scene of each kind of row) below a folder.

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
    # the first week of each row, and its scene with most reachable targets
    first = {recording.row: (max(bank, key=_reachable), recording.split) for recording, bank in reversed(banks.items())}
    small = list(reversed(first.values()))[: len(KINDS)]
    mini = write_bank(out / "mini", small, "mini", "A scene of each kind of row of the default bank, for tests.")
    return default, mini


def _reachable(scene: Scene) -> int:
    return sum(target.difficulty != "unreachable" for target in scene.targets)
