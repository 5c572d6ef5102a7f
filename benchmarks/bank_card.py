"""Write the data card of the shipped banks, ``scenes/README.md``, and its picture from the banks themselves.

python -m benchmarks.bank_card

Takes 5 minutes.
"""

from __future__ import annotations

from pathlib import Path
from string import Template
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import numpy.typing as npt

from benchmarks.common import parser, table
from greenhouse_gym.build import grown, shipped
from greenhouse_gym.common.files import data_path, write_atomically
from greenhouse_gym.geometry import distance_to_nearest
from greenhouse_gym.planning import certify
from greenhouse_gym.scene import DIFFICULTIES, SceneBank
from greenhouse_gym.scene.bank_statistics import BankStatistics, as_markdown, bank_statistics
from greenhouse_gym.scene.occupancy import OCCUPIED, REACH

mpl.use("Agg")
import matplotlib.pyplot as plt

PICTURE = "difficulty.png"
COLORS = dict(zip(DIFFICULTIES, ("#4c9f70", "#e0b040", "#c8553d", "#555555"), strict=True))

CARD = Template("""\
# The shipped banks of scenes

`default` is the bank that environments, planners and benchmarks use by default; `mini` holds one scene of each kind of
row of it, for tests. Both are data only. This card is written by `python -m benchmarks.bank_card`, the banks by
`greenhouse-gym build-shipped`; nothing here is edited by hand. `greenhouse-gym bank check` replays every witness.

## How a scene is made

A row of plants is grown ($rows rows of $length m; our own generator, or organ meshes grown by Helios), photographed by
a simulated three-camera rig with stereo noise, reconstructed to a cloud, turned into spheres, capsules and boxes, and
cut into scenes, one for each arm placement along the row ($spacing m apart, so the scenes of a recording overlap).
Nothing in it is real, and nothing was placed by hand.$progress

Every scene holds the reconstruction, which an agent knows (at most $primitives shapes within $width m along the row),
the truth (everything within $reach m of the shoulder; the leaves of Helios' plants as boxes within $leaves mm of them),
the occupancy grid of the space around the arm, and targets: at most $targets tomatoes, spread over their distances from
the shoulder. Where the arm, ready or upright, would touch the true plants, there is no scene. A recording's row keeps
its name in all weeks, and a row is in one split only.

## Difficulty

By collision checks, so that it does not depend on the machine, from the start `ready` and in the reconstruction, with
unknown space as free:

- **easy**: a straight joint motion to one of up to $goals goal configurations is free.
- **medium**: RRTConnect needs no more than $hard checks, in the median over $seeds seeds.
- **hard**: it needs more, or most runs find nothing within $most checks; if none does, one of $seeds further runs finds
  a path within $last.
- **unreachable**: no goal configuration among $samples random ones, or no run finds a path. That is no proof.

A target's certificate holds its goal configurations, the checks (medium and hard), the clearance of its witness, and
the fraction of the witness's path in unknown space. Every target is rated once more with leaves that give way.

![Targets by difficulty, style and source](difficulty.png)

## Statistics of `default`

$default
## Statistics of `mini`

$mini
## Known limits

- Arm placements of one recording are near each other: count rows, not scenes, for independent samples; intervals over
  targets of few test rows are too narrow.
- Simulated plants do not bend, and both generators hang trusses towards the aisle, as pickers turn them.
- A witness is free in the reconstruction. Only the truth holds what the reconstruction missed or invented; a plan that
  is free here can touch a leaf there. Most witnesses pass through unknown space, above and behind the view of the rig.
- At most $primitives shapes are kept; in dense rows and cherry rows the farthest are left out. The occupancy grid still
  holds their surfaces.
- Boxes of Helios' leaves lie within $leaves mm of a leaf with nearly all of their surface; at its edges the leaf
  protrudes from them by up to 3 mm.

## Splits, license, citing

Train and tune on `train`, choose on `validation`, report on `test` once. The data are under the package's license
(MIT); cite the package and its version, with the checksum above.""")


def main() -> None:
    """Read the banks and write the card."""
    command = parser(__doc__)
    command.add_argument("--scenes", type=Path, default=data_path("scenes"))
    folder = command.parse_args().scenes
    default, mini = (SceneBank.open(folder / name) for name in ("default", "mini"))
    statistics, recipe = bank_statistics(default), list(shipped.row_recordings())
    recordings, rows = len(recipe), len({recording.row for recording in recipe})
    settings = SimpleNamespace(**default[0].provenance.settings)  # of the build, not today's defaults
    progress = ""
    if statistics.recordings < recordings:
        progress = (
            f" The recipe names {recordings} recordings of {rows} rows; {statistics.recordings} of them exist "
            "so far, and the same command builds the others."
        )
    card = CARD.substitute(
        rows=statistics.rows, length=grown.ROW_LENGTH, spacing=settings.spacing,
        progress=progress, primitives=settings.max_shapes, width=settings.width, reach=settings.reach,
        leaves=f"{1000 * settings.leaf_tolerance:g}", targets=settings.max_targets,
        goals=certify.GOALS, hard=certify.HARD, seeds=certify.SEEDS, most=certify.MAX_CHECKS,
        last=certify.LAST_CHECKS, samples=certify.SAMPLES,
        default=described(default, statistics), mini=described(mini, bank_statistics(mini)),
    )  # fmt: skip
    draw(statistics.difficulties_of, folder / PICTURE)
    write_atomically(folder / "README.md", card)


def described(bank: SceneBank, statistics: BankStatistics) -> str:
    """Return the statistics of a bank, and its unexplained occupied cells, as Markdown."""
    cells = [(kind, count, f"{part:.0%}") for kind, (count, part) in sorted(unexplained_cells(bank).items())]
    text = "Occupied cells within reach, and the fraction of them that no shape explains:"
    return f"{as_markdown(statistics)}\n{text}\n\n{table(('scenes', 'cells', 'unexplained'), cells)}\n"


def unexplained_cells(bank: SceneBank) -> dict[str, tuple[int, float]]:
    """Count the occupied cells within reach, and return the fraction that no shape explains, by kind of scene.

    A shape farther from a cell's center than its corners does not explain it.
    """
    far: dict[str, list[npt.NDArray[np.bool_]]] = {}
    for entry, scene in zip(bank.manifest.scenes, bank, strict=True):
        if scene.occupancy is None:
            continue
        centers = scene.occupancy.centers[scene.occupancy.states == OCCUPIED]
        shoulder = scene.placement.position + [0.0, 0.0, scene.placement.shoulder_height]
        centers = centers[np.linalg.norm(centers - shoulder, axis=1) < REACH]
        corner = scene.occupancy.voxel * np.sqrt(3) / 2
        maximum = scene.provenance.settings["max_shapes"]
        size = f"with all of the {maximum} shapes" if len(scene.obstacles) == maximum else "with fewer shapes"
        away = distance_to_nearest(centers, scene.obstacles, corner)
        far.setdefault(f"{entry.source or 'unknown'}, {size}", []).append(away > corner)
    return {kind: (sum(map(len, parts)), float(np.concatenate(parts).mean())) for kind, parts in far.items()}


def draw(targets: dict[str, dict[str, int]], path: Path) -> None:
    """Draw the fraction of each difficulty among the targets of each style and source."""
    figure, bars = plt.subplots(figsize=(7, 3.4), dpi=80)
    kinds = sorted(targets)
    bottom = np.zeros(len(kinds))
    for difficulty in DIFFICULTIES:
        counts = [targets[kind] for kind in kinds]
        fraction = np.array([count[difficulty] / max(sum(count.values()), 1) for count in counts])
        bars.bar(kinds, fraction, bottom=bottom, color=COLORS[difficulty], label=difficulty)
        bottom += fraction
    bars.set_ylabel("fraction of the targets")
    bars.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(DIFFICULTIES), frameon=False)
    figure.tight_layout()
    figure.savefig(path)


if __name__ == "__main__":
    main()
