"""Write the data card of the shipped banks, ``scenes/README.md``, with its picture, from the banks themselves.

python benchmarks/bank_card.py
"""

from __future__ import annotations

import argparse
from pathlib import Path
from string import Template

import matplotlib as mpl
import numpy as np

from greenhouse_gym.paths import data_path, write_atomically
from greenhouse_gym.planning import certify
from greenhouse_gym.scene import DIFFICULTIES, SceneBank
from greenhouse_gym.scene.bank_statistics import as_markdown, bank_statistics

mpl.use("Agg")
import matplotlib.pyplot as plt

PICTURE = "difficulty.png"
COLORS = dict(zip(DIFFICULTIES, ("#4c9f70", "#e0b040", "#c8553d", "#555555"), strict=True))

CARD = Template("""\
# The shipped banks of scenes

`default` is the bank that environments, planners and benchmarks use when nothing else is said; `mini` holds a
scene of each kind of row of it, for tests. Both are data only. This card is written by `python
benchmarks/bank_card.py`, the banks by `greenhouse-gym build-shipped`; nothing here is edited by hand.
`greenhouse-gym bank check` replays every witness.

## How a scene is made

A row of plants is grown ($rows rows of $length m; our own generator, or organ meshes grown by Helios),
photographed by a simulated three-camera rig with stereo noise, reconstructed to a cloud, turned into spheres,
capsules and boxes, and cut into scenes, one for each place along the row where the arm is put up ($spacing m
apart, so the scenes of a recording overlap). Nothing in it is real, and nothing was placed by hand. $progress

Every scene holds what was reconstructed (at most $primitives shapes within $width m along the row, what an agent
is told), the truth (everything within $reach m of the shoulder; the leaves of Helios' plants as boxes within
$leaves mm of them), what the scan saw of the space around the arm, and targets: at most $targets tomatoes, spread
over their distances from the shoulder. A recording's row keeps its name in all weeks, and a row is in one split
only.

## Difficulty

By collision checks, so that it does not depend on the machine, and in the reconstruction, with unseen space as free:

- **easy**: a straight joint motion to one of up to $goals goal configurations is free.
- **medium**: RRTConnect needs no more than $hard checks, in the median over $seeds seeds.
- **hard**: it needs more, or most runs find nothing within $most checks.
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
  that is free here can touch a leaf there. Most witnesses pass through unseen space, above and behind what the
  rig saw.
- At most $primitives shapes are kept; in dense rows and cherry rows the farthest are left out.
- Boxes of Helios' leaves claim up to $leaves mm around a leaf, so the truth is a little stricter than the plants.

## Splits, licence, citing

Train and tune on `train`, choose on `validation`, report on `test` once. The data are under the package's licence
(MIT); cite the package and its version, with the checksum above.""")


def main() -> None:
    """Read the banks and write the card."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=Path, default=data_path("scenes"))
    folder = parser.parse_args().scenes
    from greenhouse_gym import shipped

    default, mini = (SceneBank.open(folder / name) for name in ("default", "mini"))
    statistics = bank_statistics(default)
    recordings = len(list(shipped.shots()))
    settings = shipped.SETTINGS
    built = ""
    if statistics.recordings < recordings:
        built = (
            f"The recipe names {recordings} recordings of {shipped.ROWS} rows; {statistics.recordings} of them are "
            "here so far, and the same command goes on with the others."
        )
    card = CARD.substitute(
        rows=statistics.rows, length=shipped.ROW_LENGTH, spacing=settings.spacing, progress=built,
        primitives=settings.primitives, width=settings.width, reach=settings.reach,
        leaves=f"{1000 * settings.leaves:g}", targets=settings.targets, goals=certify.GOALS,
        hard=certify.HARD, seeds=certify.SEEDS, most=certify.MAX_CHECKS,
        samples=certify.SAMPLES, default=as_markdown(statistics), mini=as_markdown(bank_statistics(mini)),
    )  # fmt: skip
    draw(default, folder / PICTURE)
    write_atomically(folder / "README.md", card)


def draw(bank: SceneBank, path: Path) -> None:
    """Targets by difficulty for each style and source, and the checks that RRTConnect needed."""
    figure, (bars, checks) = plt.subplots(1, 2, figsize=(10, 3.6), dpi=80)
    kinds = sorted({(scene.provenance.source or "", scene.provenance.style or "") for scene in bank})
    counts = {kind: dict.fromkeys(DIFFICULTIES, 0) for kind in kinds}
    needed: list[int] = []
    for scene in bank:
        for target in scene.targets:
            counts[scene.provenance.source or "", scene.provenance.style or ""][target.difficulty] += 1
            needed += [target.checks] if target.checks else []
    bottom = np.zeros(len(kinds))
    for difficulty in DIFFICULTIES:
        share = np.array([counts[kind][difficulty] / sum(counts[kind].values()) for kind in kinds])
        bars.bar([" ".join(kind) for kind in kinds], share, bottom=bottom, color=COLORS[difficulty], label=difficulty)
        bottom += share
    bars.set_ylabel("share of the targets")
    bars.tick_params(axis="x", rotation=25)
    bars.legend(fontsize=8, loc="lower left")
    checks.hist(needed, bins=np.geomspace(50, certify.MAX_CHECKS, 30), color="#5b7fa6")
    checks.axvline(certify.HARD, color=COLORS["hard"])
    checks.set_xscale("log")
    checks.set_xlabel("collision checks of RRTConnect, medium and hard targets")
    checks.set_ylabel("targets")
    figure.tight_layout()
    figure.savefig(path)


if __name__ == "__main__":
    main()
