"""Fit the network that says which small spheres are fruit, and check it on rows that it was not fitted to.

python benchmarks/fit_small_fruit.py --workdir rows

The rows are development rows of both sources and rows of drawn cultivars; none is held out. Development rows are looked
at in perfect images as well, since other cameras have less noise. A sphere is a fruit as in fit_credibility.py. The
network judges twice, the second time beside what it was sure of the first. It learns from both, and from the same
spheres without any color or company, so that it judges stems and seedlings by their shape. By fifths of the rows it is
fitted to the others first, and the tomatoes found are counted with and without it. Then it is fitted to all rows and
written to greenhouse_gym/shapes/small_fruit.json.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from fit_credibility import Labeled, labeled, surfaces_of
from fit_network import FIFTHS, causes_of, count_tomatoes, learned, print_counts, rows_to_fit, write_network
from shape_rows import CAUSES, Row, visible_of

from greenhouse_gym.accuracy import Visibility
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.candidates import COMPANY, MEASURES
from greenhouse_gym.shapes.networks import Network, network_file
from greenhouse_gym.shapes.small_fruit import Credited, Small, chosen_small, small_spheres, sure_small
from greenhouse_gym.shapes.surroundings import OF_COLOR
from greenhouse_gym.shapes.tomatoes import large_tomatoes, look

SETTINGS = ShapeSettings()


class Looked(NamedTuple):
    """What the first two looks have found in a row, what is to be judged, and the truth."""

    found: Credited
    small: Small
    true: Sequence[Tomato]
    visible: Visibility

    def beside(self, chosen: Sequence[int]) -> Labeled:
        """The measures of all small spheres beside some that are sure, with labels."""
        return labeled(self.small.fits, self.small.beside(self.found, chosen, SETTINGS), self.true)


def looked_at(row: Row, workdir: Path, cause: str) -> Looked:
    """Look at a row's cloud of one of the `CAUSES`."""
    surface, fine, true = surfaces_of(row, workdir, cause)
    found = large_tomatoes(look(surface, SETTINGS), SETTINGS)
    return Looked(found, small_spheres(fine, SETTINGS), true, visible_of(row, workdir).tomatoes)


def fitted(rows: Sequence[Looked]) -> Network:
    """The network that learned both judgements from rows."""
    first = [part for row in rows for part in (row.beside([]), _colorless(row))]
    judge = learned(first)
    return learned([*first, *(row.beside(sure_small(row.small, row.found, SETTINGS, judge)) for row in rows)])


def _colorless(row: Looked) -> Labeled:
    """The measures of a row's small spheres as in a cloud of one color that holds no other fruit."""
    alone = row.small.alone.copy()
    alone[:, [MEASURES.index(name) for name in ("contrast", "tone spread")]] = 0.0
    alone[:, len(MEASURES) + np.array(OF_COLOR)] = 0.0
    company = np.zeros((len(alone), len(COMPANY)))
    return labeled(row.small.fits, np.column_stack([alone, company]), row.true)


def counted(row: Looked, network: Network | None) -> np.ndarray:
    """The tomatoes of a row that are found with a network or without; see `count_tomatoes`."""
    found = list(row.found.fits)
    if network is not None:
        found += chosen_small(row.small, row.found, SETTINGS, network).fits
    return count_tomatoes(row.true, row.visible, found)


def main() -> None:
    """Check by fifths, fit to all, write."""
    rows: list[dict[str, Looked]] = []
    chosen, workdir = rows_to_fit(__doc__)
    for row in chosen:
        rows.append({cause: looked_at(row, workdir, cause) for cause in causes_of(row)})
        print(row.name, [len(looked.small.fits) for looked in rows[-1].values()], "small spheres", flush=True)
    with_it = dict.fromkeys(CAUSES, np.zeros(3, dtype=int))
    for k in range(FIFTHS):
        network = fitted([looked for i, row in enumerate(rows) if i % FIFTHS != k for looked in row.values()])
        for row in rows[k::FIFTHS]:
            for cause, looked in row.items():
                with_it[cause] = with_it[cause] + counted(looked, network)
    for cause in CAUSES:
        without = np.sum([counted(row[cause], None) for row in rows if cause in row], axis=0)
        print_counts({f"{cause}, without": without, f"{cause}, with": with_it[cause]})
    write_network(fitted([looked for row in rows for looked in row.values()]), network_file("small_fruit"))


if __name__ == "__main__":
    main()
