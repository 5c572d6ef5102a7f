"""Fit the networks that say where peduncles and pedicels may run, and check them on rows that they were not fitted to.

python benchmarks/fit_peduncles.py --workdir rows

The rows are those of fit_small_fruit.py; none is held out. Development rows are looked at in perfect images as well,
since other cameras have less noise, and all of them without color. A place is right if it lies no more than 2 mm off a
true peduncle or pedicel, seen or not. A first network judges places by themselves, and a second one beside what the
first says of their neighborhood. By fifths of the rows they are fitted to the others first, and what they find is
compared with the truth. Then they are fitted to all rows and written to greenhouse_gym/shapes/peduncles.json and
peduncles_in_context.json.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from fit_credibility import surfaces_of
from fit_network import FIFTHS, causes_of, fitted_network, rows_to_fit, write_network
from shape_rows import CAUSES, Row, cloud_of, truth_of, visible_of

from greenhouse_gym.accuracy import compare_stems
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Capsule, distance_to_shapes
from greenhouse_gym.shapes import ShapeSettings, extract_shapes
from greenhouse_gym.shapes.bare_peduncles import find_bare_peduncles
from greenhouse_gym.shapes.likely_places import in_context
from greenhouse_gym.shapes.networks import Network, network_file
from greenhouse_gym.shapes.peduncles import find_peduncles
from greenhouse_gym.shapes.thin_stems import OF_COLOR, Places, places_near_fruit

KINDS = ("peduncle", "pedicel")
NEAR = 0.002  # metres
SETTINGS = ShapeSettings()


class Looked(NamedTuple):
    """What was found in a row, the places to be judged, which of them (n,) are right, and the truth."""

    tomatoes: tuple[Tomato, ...]
    main: list[Stem]
    places: Places
    right: np.ndarray
    true: Sequence[Stem]
    visible: Sequence[Stem]
    petioles: Sequence[Capsule]


def looked_at(row: Row, workdir: Path, cause: str) -> Looked:
    """Look at a row's cloud of one of the `CAUSES`."""
    surface, _, _ = surfaces_of(row, workdir, cause)
    cloud = cloud_of(row, cause, workdir)
    known = truth_of(row, cloud, workdir)
    cloud = cloud.transformed(known.world_from_row)
    shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals, SETTINGS)
    main = [stem for stem in shapes.stems if stem.kind == "main"]
    places = places_near_fruit(surface, shapes.tomatoes, main, SETTINGS)
    true = known.row.stems
    away = distance_to_shapes(places.nodes, [stem for stem in true if stem.kind in KINDS]).min(axis=1)
    petioles = [shape for shape in known.row.clutter if isinstance(shape, Capsule)]
    return Looked(shapes.tomatoes, main, places, away < NEAR, true, visible_of(row, workdir).stems, petioles)


def fitted(rows: Sequence[Looked]) -> tuple[Network, Network]:
    """The networks of the first judgement and of the one in its context, in the rows' colors and without.

    The second learns from what the first says of rows that it was not fitted to.
    """
    parts = [part for row in rows for part in (row.places, _colorless(row.places))]
    right = [right for row in rows for right in (row.right, row.right)]
    context = [np.zeros(0)] * len(parts)
    for k in range(FIFTHS):
        held = [i for i in range(len(parts)) if i // 2 % FIFTHS == k]
        others = [i for i in range(len(parts)) if i not in held]
        first = _learned([parts[i].measures for i in others], [right[i] for i in others])
        for i in held:
            context[i] = in_context(parts[i], first(parts[i].measures))
    return _learned([part.measures for part in parts], right), _learned(context, right)


def _colorless(places: Places) -> Places:
    """Places as in a cloud of one color."""
    measures = places.measures.copy()
    measures[:, OF_COLOR] = 0.0
    return places._replace(measures=measures)


def _learned(measures: Sequence[np.ndarray], right: Sequence[np.ndarray]) -> Network:
    return fitted_network(np.concatenate(measures), np.concatenate(right))


def counted(row: Looked, first: Network, second: Network) -> np.ndarray:
    """Metres of what holds a row's fruit: seen by the rig, found of these, extracted, and extracted falsely."""
    likely, nodes = second(in_context(row.places, first(row.places.measures))), row.places.nodes
    stems = find_peduncles(nodes[likely > SETTINGS.min_peduncle], row.tomatoes, row.main, SETTINGS)
    stems += find_bare_peduncles(nodes[likely > SETTINGS.min_bare_peduncle], [*row.main, *stems], SETTINGS)
    sums = [compare_stems(row.true, row.visible, row.petioles, stems, kind) for kind in KINDS]
    return np.sum([[s.visible, s.found, s.extracted, s.false] for s in sums], axis=0)


def main() -> None:
    """Check by fifths, fit to all, write."""
    rows: list[tuple[str, dict[str, Looked]]] = []
    chosen, workdir = rows_to_fit(__doc__)
    for row in chosen:
        rows.append((row.source, {cause: looked_at(row, workdir, cause) for cause in causes_of(row)}))
        print(row.name, [len(looked.right) for looked in rows[-1][1].values()], "places", flush=True)
    sums = {(source, cause): np.zeros(4) for source in ("own", "helios") for cause in CAUSES}
    for k in range(FIFTHS):
        networks = fitted([looked for i, (_, row) in enumerate(rows) if i % FIFTHS != k for looked in row.values()])
        for source, row in rows[k::FIFTHS]:
            for cause, looked in row.items():
                sums[source, cause] += counted(looked, *networks)
    for (source, cause), (visible, found, extracted, false) in sums.items():
        if visible:
            print(f"{source}, {cause}: {found / visible:.3f} of {visible:.1f} m found, {false / extracted:.3f} false")
    first, second = fitted([looked for _, row in rows for looked in row.values()])
    write_network(first, network_file("peduncles"))
    write_network(second, network_file("peduncles_in_context"))


if __name__ == "__main__":
    main()
