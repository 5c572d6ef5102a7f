"""Fit the networks that judge spheres of the first two looks, and check them on rows that they were not fitted to.

python benchmarks/fit_large_fruit.py --workdir rows

The rows are those of fit_small_fruit.py; none is held out. All grids of voxels are looked at. A sphere is a fruit as in
fit_credibility.py. By fifths of the rows the networks are fitted to the others first, and the tomatoes found by one
grid are counted, small ones aside, with and without them. Then they are fitted to all rows and written to
greenhouse_gym/shapes/large_fruit.json and large_fruit_beside.json.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from fit_credibility import Labeled, grids_of, labeled
from fit_network import FIFTHS, causes_of, count_tomatoes, learned, print_counts, rows_to_fit, write_network
from shape_rows import CAUSES, Row, visible_of

from greenhouse_gym.accuracy import Visibility
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import pose
from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.credibility import BESIDE, IN_ROW, Judge, Judges, credibility
from greenhouse_gym.shapes.networks import network_file
from greenhouse_gym.shapes.tomatoes import Looks, large_tomatoes, look

SETTINGS = ShapeSettings()


class Looked(NamedTuple):
    """What one grid shows of a row, the candidates of both looks with labels, and the truth."""

    looks: Looks
    first: Labeled
    second: Labeled
    true: Sequence[Tomato]
    visible: Visibility


def looked_at(row: Row, workdir: Path, cause: str) -> list[Looked]:
    """Look at a row's cloud of one of the `CAUSES`, grid by grid."""
    visible, found = visible_of(row, workdir).tomatoes, []
    grids, true = grids_of(row, workdir, cause)
    for grid in grids:
        moved = [tomato.transformed(pose(translation=grid.shift)) for tomato in true]
        looks = look(grid.surface, SETTINGS)
        first, second = labeled(looks.fits, looks.first, moved), labeled(looks.beside, looks.second, moved)
        found.append(Looked(looks, first, second, moved, visible))
    return found


def fitted(rows: Sequence[Looked]) -> Judges:
    """The networks that learned from rows."""
    return Judges(learned([row.first for row in rows]), learned([row.second for row in rows]))


def regression(weights: np.ndarray) -> Judge:
    """Judges as a regression does, which the mean with it does not change."""
    return lambda measures: credibility(measures[:, : len(weights) - 1], weights)


def counted(row: Looked, judges: Judges) -> np.ndarray:
    """The tomatoes of a row that some judges find; see `count_tomatoes`."""
    return count_tomatoes(row.true, row.visible, large_tomatoes(row.looks, SETTINGS, judges).fits)


def main() -> None:
    """Check by fifths, fit to all, write."""
    rows: list[dict[str, list[Looked]]] = []
    chosen, workdir = rows_to_fit(__doc__)
    for row in chosen:
        rows.append({cause: looked_at(row, workdir, cause) for cause in causes_of(row)})
        print(row.name, [len(looked[0].looks.fits) for looked in rows[-1].values()], "spheres", flush=True)

    def of(some: Sequence[dict[str, list[Looked]]]) -> list[Looked]:
        return [grid for row in some for grids in row.values() for grid in grids]

    alone = Judges(regression(IN_ROW), regression(BESIDE))
    with_them = dict.fromkeys(CAUSES, np.zeros(3, dtype=int))
    for k in range(FIFTHS):
        judges = fitted(of([row for i, row in enumerate(rows) if i % FIFTHS != k]))
        for row in rows[k::FIFTHS]:
            for cause, grids in row.items():
                with_them[cause] = with_them[cause] + counted(grids[0], judges)
    for cause in CAUSES:
        without = np.sum([counted(row[cause][0], alone) for row in rows if cause in row], axis=0)
        print_counts({f"{cause}, without": without, f"{cause}, with": with_them[cause]})
    first, second = fitted(of(rows))
    write_network(first, network_file("large_fruit"))
    write_network(second, network_file("large_fruit_beside"))


if __name__ == "__main__":
    main()
