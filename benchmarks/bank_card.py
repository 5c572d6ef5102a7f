"""Write the data card of the shipped banks, ``scenes/README.md``, with its picture, from the banks themselves.

python benchmarks/bank_card.py
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from string import Template
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.files import data_path, write_atomically
from greenhouse_gym.geometry import Box, distance_to_nearest, distance_to_shapes
from greenhouse_gym.planning import certify
from greenhouse_gym.scene import DIFFICULTIES, SceneBank
from greenhouse_gym.scene.manifest import SPLITS
from greenhouse_gym.scene.occupancy import OCCUPIED, REACH

mpl.use("Agg")
import matplotlib.pyplot as plt

PICTURE = "difficulty.png"
COLORS = dict(zip(DIFFICULTIES, ("#4c9f70", "#e0b040", "#c8553d", "#555555"), strict=True))

CARD = Template("""\
# The shipped banks of scenes

`default` is the bank that environments, planners and benchmarks use when nothing else is said; `mini` holds a
scene of each kind of row of it, for tests. Both are data only. This card is written by `python
benchmarks/bank_card.py`, the banks by `greenhouse-gym build-shipped`, the leaves of their truth once more by `python
benchmarks/renew_truth.py`; nothing here is edited by hand.
`greenhouse-gym bank check` replays every witness.

## How a scene is made

A row of plants is grown ($rows rows of $length m; our own generator, or organ meshes grown by Helios),
photographed by a simulated three-camera rig with stereo noise, reconstructed to a cloud, turned into spheres,
capsules and boxes, and cut into scenes, one for each place along the row where the arm is put up ($spacing m
apart, so the scenes of a recording overlap). Nothing in it is real, and nothing was placed by hand. $progress

Every scene holds what was reconstructed (at most $primitives shapes within $width m along the row, what an agent
is told), the truth (everything within $reach m of the shoulder; the leaves of Helios' plants as boxes within
$leaves mm of them), what the scan saw of the space around the arm, and targets: at most $targets tomatoes, spread
over their distances from the shoulder. Where the arm would begin in the true plants nobody would put it up: there
is no scene of such a place. A recording's row keeps its name in all weeks, and a row is in one split only.

## Difficulty

By collision checks, so that it does not depend on the machine, and in the reconstruction, with unknown space as free:

- **easy**: a straight joint motion to one of up to $goals goal configurations is free.
- **medium**: RRTConnect needs no more than $hard checks, in the median over $seeds seeds.
- **hard**: it needs more, or most runs find nothing within $most checks; where none does, one of $seeds
  further runs finds a path within $last.
- **unreachable**: no goal configuration among $samples random ones, or no run finds a path. That is no proof.

A target's certificate tells its goal configurations, the checks (medium and hard), the clearance of its witness,
and the share of the witness's way through space that the scan did not see.

![Targets by difficulty, style and source](difficulty.png)

## Statistics of `default`

$default
## Statistics of `mini`

$mini
## Known limits

- Stands of one recording are near each other: count rows, not scenes, for independent samples; intervals over
  targets of few test rows are too narrow.
- Simulated plants do not bend, and both generators hang trusses towards the aisle, as pickers turn them.
- A witness is free in the reconstruction. What the reconstruction missed or invented is told by the truth; a plan
  that is free here can touch a leaf there. Most witnesses pass through unknown space, above and behind what the
  rig saw.
- At most $primitives shapes are kept; in dense rows and cherry rows the farthest are left out. That there are
  surfaces is still told by what the scan saw of the space around the arm.
- Boxes of Helios' leaves lie within $leaves mm of a leaf with nearly all of their surface; at its edges the leaf sticks
  out of them by up to 3 mm.

## Splits, license, citing

Train and tune on `train`, choose on `validation`, report on `test` once. The data are under the package's license
(MIT); cite the package and its version, with the checksum above.""")


def main() -> None:
    """Read the banks and write the card."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=Path, default=data_path("scenes"))
    folder = parser.parse_args().scenes
    from greenhouse_gym.build import shipped

    default, mini = (SceneBank.open(folder / name) for name in ("default", "mini"))
    entries = default.manifest.scenes
    rows, made = len({entry.row for entry in entries}), len({entry.name.rsplit("-", 1)[0] for entry in entries})
    recordings = len(list(shipped.row_recordings()))
    settings = SimpleNamespace(**default[0].provenance.settings)  # what they were built with, whatever is usual now
    built = ""
    if made < recordings:
        built = (
            f"The recipe names {recordings} recordings of {shipped.ROWS} rows; {made} of them are "
            "here so far, and the same command goes on with the others."
        )
    card = CARD.substitute(
        rows=rows, length=shipped.ROW_LENGTH, spacing=settings.spacing, progress=built,
        primitives=settings.max_shapes, width=settings.width, reach=settings.reach,
        leaves=f"{1000 * settings.leaf_tolerance:g}", targets=settings.max_targets, goals=certify.GOALS,
        hard=certify.HARD, seeds=certify.SEEDS, most=certify.MAX_CHECKS, last=certify.LAST_CHECKS,
        samples=certify.SAMPLES, default=tables(default), mini=tables(mini),
    )  # fmt: skip
    draw(shares(default), folder / PICTURE)
    write_atomically(folder / "README.md", card)


def shares(bank: SceneBank) -> dict[str, Counter[str]]:
    """Targets of each difficulty, of all and of each style and source, as the manifest tells them."""
    found: dict[str, Counter[str]] = {}
    for entry in bank.manifest.scenes:
        for kind in ("all", entry.style or "unknown", entry.source or "unknown", entry.protocol or "paper"):
            found.setdefault(kind, Counter()).update(
                {str(name): count for name, count in (entry.targets or {}).items()}
            )
    return found


def tables(bank: SceneBank) -> str:
    """The bank in numbers; `greenhouse-gym bank info` reads the scenes and tells more."""
    entries = bank.manifest.scenes
    lines = [
        f"{len(entries)} scenes of {len({entry.row for entry in entries})} rows, "
        f"{sum((bank.path / entry.file).stat().st_size for entry in entries) / 1e6:.1f} MB",
        "",
        f"Checksum of the manifest (SHA-256): `{bank.sha256}`",
        "",
        "| split | scenes | rows |",
        "| --- | --- | --- |",
    ]
    for split in SPLITS:
        mine = [entry.row for entry in entries if entry.split == split]
        lines.append(f"| {split} | {len(mine)} | {len(set(mine))} |")
    thick, inside = foliage(bank)
    lines += [
        "",
        f"Half of the boxes are thicker than {1000 * thick:.0f} mm; {inside:.1%} of the tomatoes' centers lie in one.",
    ]
    lines += ["", "Voxels within reach in which the scan saw a surface, and the share of them that no shape is in:"]
    lines += ["", "| scenes | voxels | without a shape |", "| --- | --- | --- |"]
    for scenes, (count, share) in sorted(surfaces_without_shapes(bank).items()):
        lines.append(f"| {scenes} | {count} | {share:.0%} |")
    lines += ["", "| targets | " + " | ".join(DIFFICULTIES) + " |", "| --- " * 5 + "|"]
    for kind, counts in shares(bank).items():
        of = [f"{counts[name]} ({counts[name] / max(sum(counts.values()), 1):.1%})" for name in DIFFICULTIES]
        lines.append(f"| {kind} | {' | '.join(of)} |")
    return "\n".join(lines) + "\n"


def foliage(bank: SceneBank) -> tuple[float, float]:
    """The median thickness of boxes, metres, and the share of tomatoes whose center lies in one."""
    thickness: list[float] = []
    inside: list[bool] = []
    for scene in bank:
        boxes = [shape for shape in scene.clutter if isinstance(shape, Box)]
        thickness += [2 * float(box.half_extents.min()) for box in boxes]
        centers = [tomato.center for tomato in scene.tomatoes]
        inside += (distance_to_shapes(centers, boxes).min(axis=1, initial=np.inf) < 0).tolist()
    return float(np.median(thickness)), float(np.mean(inside))


def surfaces_without_shapes(bank: SceneBank) -> dict[str, tuple[int, float]]:
    """Voxels within reach in which the scan saw a surface, and the share of them that no shape is in, by kind of scene.

    A shape farther from a voxel's middle than its corners are is not in it; one nearer than that is taken to be.
    """
    far: dict[str, list[npt.NDArray[np.bool_]]] = {}
    for entry, scene in zip(bank.manifest.scenes, bank, strict=True):
        if scene.occupancy is None:
            continue
        centers = scene.occupancy.centers[scene.occupancy.states == OCCUPIED]
        shoulder = scene.placement.position + [0.0, 0.0, scene.placement.shoulder_height]
        centers = centers[np.linalg.norm(centers - shoulder, axis=1) < REACH]
        corner = scene.occupancy.voxel * np.sqrt(3) / 2
        most = scene.provenance.settings["max_shapes"]
        size = f"with all of the {most} shapes" if len(scene.obstacles) == most else "with fewer shapes"
        away = distance_to_nearest(centers, scene.obstacles, corner)
        far.setdefault(f"{entry.source or 'unknown'}, {size}", []).append(away > corner)
    return {kind: (sum(map(len, parts)), float(np.concatenate(parts).mean())) for kind, parts in far.items()}


def draw(found: dict[str, Counter[str]], path: Path) -> None:
    """Share of each difficulty among the targets of each style and source."""
    figure, bars = plt.subplots(figsize=(7, 3.4), dpi=80)
    kinds = sorted(found)
    bottom = np.zeros(len(kinds))
    for difficulty in DIFFICULTIES:
        counts = [found[kind] for kind in kinds]
        share = np.array([count[difficulty] / max(sum(count.values()), 1) for count in counts])
        bars.bar(kinds, share, bottom=bottom, color=COLORS[difficulty], label=difficulty)
        bottom += share
    bars.set_ylabel("share of the targets")
    bars.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(DIFFICULTIES), frameon=False)
    figure.tight_layout()
    figure.savefig(path)


if __name__ == "__main__":
    main()
