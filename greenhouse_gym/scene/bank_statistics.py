"""Statistics of a bank by split, style, source and difficulty."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from textwrap import wrap

import numpy as np

from greenhouse_gym.common.tables import Table, number
from greenhouse_gym.scene.bank import SceneBank
from greenhouse_gym.scene.manifest import SPLITS
from greenhouse_gym.scene.occupancy import REACH
from greenhouse_gym.scene.scene import DIFFICULTIES, Scene

_WIDTH = 62  # characters of a column of words


@dataclass(frozen=True)
class BankStatistics:
    """Statistics of a bank.

    Attributes:
        name: Name of the bank.
        sha256: Checksum of its manifest, which covers all scenes.
        scenes: Number of scenes.
        rows: Number of rows.
        recordings: Number of recordings.
        megabytes: Total size of the scene files.
        splits: Number of scenes and rows in each split.
        kinds: Number of scenes by style, source, protocol and week; missing values are "unknown".
        difficulties: Number of targets by difficulty.
        difficulties_of: Number of targets by difficulty, for each style and source.
        per_scene: Mean numbers of tomatoes, shapes and targets in a scene.
        truth: Number of scenes with truth, and the mean number of shapes in it.
        known: Number of scenes with an occupancy grid, and the mean fraction of the space within reach that is known.
        checks: Median collision checks of RRTConnect for medium and hard targets.
        clearance: Median clearance of the witnesses, metres.
        unknown: Median fraction of the witnesses' paths through unknown space.
    """

    name: str
    sha256: str
    scenes: int
    rows: int
    recordings: int
    megabytes: float
    splits: dict[str, tuple[int, int]]
    kinds: dict[str, dict[str, int]]
    difficulties: dict[str, int]
    difficulties_of: dict[str, dict[str, int]]
    per_scene: dict[str, float]
    truth: tuple[int, float]
    known: tuple[int, float]
    checks: dict[str, float]
    clearance: float
    unknown: float


def bank_statistics(bank: SceneBank, on_progress: Callable[[int], None] = lambda done: None) -> BankStatistics:
    """Compute the statistics of a bank; all scenes are read.

    Args:
        bank: The bank.
        on_progress: Called with the number of scenes read so far.

    Raises:
        FileFormatError: A scene is missing or damaged, or its checksum differs from the manifest's.
    """
    entries, scenes = bank.manifest.scenes, list[Scene]()
    known, size = list[float](), 0
    for scene in bank:
        scenes.append(scene)
        size += len(scene.model_dump_json()) + 1
        known += [] if scene.occupancy is None else [_known_fraction(scene)]
        on_progress(len(scenes))
    targets = [target for scene in scenes for target in scene.targets]
    kinds = ("style", "source", "protocol", "week")
    by_kind: dict[str, Counter[str]] = {}
    for scene in scenes:
        for kind in ("style", "source"):
            name = getattr(scene.provenance, kind) or f"unknown {kind}"
            by_kind.setdefault(name, Counter()).update(target.difficulty for target in scene.targets)
    true = [scene.truth.count for scene in scenes if scene.truth is not None]
    return BankStatistics(
        name=bank.manifest.name,
        sha256=bank.sha256,
        scenes=len(scenes),
        rows=len({entry.row for entry in entries}),
        recordings=len({scene.provenance.recording or scene.name for scene in scenes}),
        megabytes=size / 1e6,
        splits={
            split: (len(bank.names(split)), len({entry.row for entry in entries if entry.split == split}))
            for split in SPLITS
        },
        kinds={
            kind: dict(sorted(Counter(_label(getattr(entry, kind)) for entry in entries).items())) for kind in kinds
        },
        difficulties={name: sum(target.difficulty == name for target in targets) for name in DIFFICULTIES},
        difficulties_of={
            name: {difficulty: found[difficulty] for difficulty in DIFFICULTIES} for name, found in by_kind.items()
        },
        per_scene={
            "tomatoes": _mean([len(scene.tomatoes) for scene in scenes]),
            "shapes": _mean([scene.count for scene in scenes]),
            "targets": _mean([len(scene.targets) for scene in scenes]),
        },
        truth=(len(true), _mean(true)),
        known=(len(known), _mean(known)),
        checks={
            name: _median([t.checks for t in targets if t.difficulty == name and t.checks is not None])
            for name in ("medium", "hard")
        },
        clearance=_median([t.clearance for t in targets if t.clearance is not None]),
        unknown=_median([t.unknown for t in targets if t.unknown is not None]),
    )


def _label(value: object) -> str:
    return "unknown" if value is None else f"{value:02d}" if isinstance(value, int) else str(value)


def _mean(values: list[int] | list[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


def _median(values: list[int] | list[float]) -> float:
    return float(np.median(values)) if values else float("nan")


def as_markdown(found: BankStatistics) -> str:
    """Return the statistics as Markdown tables."""
    total = max(sum(found.difficulties.values()), 1)
    size = f"{found.scenes} scenes of {found.recordings} recordings of {found.rows} rows, {total} targets"
    kinds = [line for kind, counts in found.kinds.items() for line in _wrapped(kind, counts)]
    figures = [
        *((f"{name} in a scene, mean", number(mean, ".1f")) for name, mean in found.per_scene.items()),
        ("scenes with truth", str(found.truth[0])),
        ("shapes in it, mean", number(found.truth[1], ".0f")),
        ("scenes with an occupancy grid", str(found.known[0])),
        ("known fraction within reach, mean", number(found.known[1], ".0%")),
        *((f"checks of RRTConnect, {name}, median", number(value, ".0f")) for name, value in found.checks.items()),
        ("clearance of the witnesses, mm, median", number(1000 * found.clearance, ".1f")),
        ("fraction of the witnesses' paths through unknown space, median", number(found.unknown, ".0%")),
    ]
    groups = {"all": found.difficulties, **found.difficulties_of}
    tables = (
        Table(("split", "scenes", "rows"), [(split, *map(str, counts)) for split, counts in found.splits.items()]),
        Table(("kind", "scenes of each"), kinds, words=(0, 1)),
        Table(("targets", *DIFFICULTIES), [_with_fractions(name, counts) for name, counts in groups.items()]),
        Table(("figure", "value"), figures),
    )
    head = f"{size}, {found.megabytes:.1f} MB\n\nChecksum of the manifest (SHA-256): `{found.sha256}`\n"
    return "\n".join((head, *(table.as_markdown() for table in tables)))


def _wrapped(kind: str, counts: dict[str, int]) -> list[tuple[str, str]]:
    """Return the counts of a kind in lines that fit a terminal, the kind at the first of them."""
    lines = wrap(", ".join(f"{name.replace(' ', '~')}~{count}" for name, count in counts.items()), _WIDTH)
    return [("" if k else kind, line.replace("~", " ")) for k, line in enumerate(lines)]


def _with_fractions(name: str, counts: dict[str, int]) -> list[str]:
    total = max(sum(counts.values()), 1)
    return [name, *(f"{counts[difficulty]} ({counts[difficulty] / total:.1%})" for difficulty in DIFFICULTIES)]


def _known_fraction(scene: Scene) -> float:
    """Return the known fraction of the space within `REACH` of the shoulder."""
    assert scene.occupancy is not None
    return scene.occupancy.known_fraction(scene.placement.position + [0.0, 0.0, scene.placement.shoulder_height], REACH)
