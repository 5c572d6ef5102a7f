"""Fit the classifiers of shape extraction to simulated rows, after checking them on rows left out of the fit.

python -m training.shape_networks large --workdir rows

``seeds`` prints the logistic weights that select the first confident spheres; ``large`` fits the networks that score
spheres of the first two passes, ``small`` the one for small spheres, ``peduncles`` the two for points on peduncles and
pedicels. Rows are development rows of both sources and rows of random cultivars; none is held out. Development rows are
also seen in perfect images, since other cameras have less noise. By fifths of the rows the networks are fitted to the
others and what they find is compared with the truth; then they are fitted to all rows and written into the package.
Takes one to three hours, most of it for rows that are not yet in --workdir.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from greenhouse_gym.shapes.bare_peduncles import find_bare_peduncles
from greenhouse_gym.shapes.candidates import COMPANY, MEASURES
from greenhouse_gym.shapes.credibility import Judges, credibility
from greenhouse_gym.shapes.likely_places import in_context
from greenhouse_gym.shapes.peduncles import find_peduncles
from greenhouse_gym.shapes.small_fruit import Credited, Small, chosen_small, small_spheres, sure_small
from greenhouse_gym.shapes.surroundings import OF_COLOR as SHELL_COLORS
from greenhouse_gym.shapes.thin_stems import OF_COLOR as PEDUNCLE_COLORS
from greenhouse_gym.shapes.thin_stems import Places, places_near_fruit
from greenhouse_gym.shapes.tomatoes import Looks, large_tomatoes, look

from benchmarks.sensing.rows import CAUSES, DRAWN_MESHES, Row, cloud_of, truth_of, visible_of
from greenhouse_gym.accuracy import Visibility, compare_stems
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Array, Capsule, distance_to_shapes
from greenhouse_gym.shapes import ShapeSettings, extract_shapes
from greenhouse_gym.shapes.networks import Network
from training.fitting import (
    FOLDS,
    Labeled,
    causes_of,
    count_tomatoes,
    cross_validated,
    fit_labeled,
    fit_network,
    label_spheres,
    surfaces_of,
    write_network,
)

SETTINGS = ShapeSettings()
SHIFTS = ((0.0, 0.0, 0.0), (0.0137, 0.0211, 0.0173))
"""Shifts of the cloud, m, so that it falls into other voxels."""
RIDGE = 2.0
HANGING = ("peduncle", "pedicel")
NEAR = 0.002  # m


class Spheres(NamedTuple):
    """Spheres of the first two passes with labels, and the truth."""

    looks: Looks
    first: Labeled
    second: Labeled
    true: list[Tomato]
    visible: Visibility

    @classmethod
    def of(cls, row: Row, workdir: Path, cause: str, shift: Sequence[float] = SHIFTS[0]) -> Spheres:
        """Fit the spheres of a row's cloud."""
        surface, _, true = surfaces_of(row, workdir, cause, SETTINGS, shift)
        looks = look(surface, SETTINGS)
        first = label_spheres(looks.fits, looks.first, true)
        second = label_spheres(looks.beside, looks.second, true)
        return cls(looks, first, second, true, visible_of(row, workdir).tomatoes)


class SmallSpheres(NamedTuple):
    """Small spheres of a row, the large tomatoes found in it, and the truth."""

    found: Credited
    small: Small
    true: list[Tomato]
    visible: Visibility

    @classmethod
    def of(cls, row: Row, workdir: Path, cause: str) -> SmallSpheres:
        """Fit the small spheres of a row's cloud."""
        surface, fine, true = surfaces_of(row, workdir, cause, SETTINGS)
        found = large_tomatoes(look(surface, SETTINGS), SETTINGS)
        return cls(found, small_spheres(fine, SETTINGS), true, visible_of(row, workdir).tomatoes)

    def labeled(self, chosen: Sequence[int]) -> Labeled:
        """Return the small spheres in the context of the chosen ones, with labels."""
        return label_spheres(self.small.fits, self.small.beside(self.found, chosen, SETTINGS), self.true)

    def colorless(self) -> Labeled:
        """Return the small spheres as in a cloud of one color without other fruit, with labels."""
        alone = self.small.alone.copy()
        alone[:, [MEASURES.index(name) for name in ("contrast", "tone spread")]] = 0.0
        alone[:, len(MEASURES) + np.array(SHELL_COLORS)] = 0.0
        features = np.column_stack([alone, np.zeros((len(alone), len(COMPANY)))])
        return label_spheres(self.small.fits, features, self.true)


class Peduncles(NamedTuple):
    """Points on possible peduncles with labels (n,), the tomatoes and main stems of the row, and the truth."""

    tomatoes: tuple[Tomato, ...]
    main: list[Stem]
    points: Places
    labels: Array
    true: Sequence[Stem]
    visible: Sequence[Stem]
    petioles: Sequence[Capsule]

    @classmethod
    def of(cls, row: Row, workdir: Path, cause: str) -> Peduncles:
        """Find the points of a row's cloud."""
        surface, _, _ = surfaces_of(row, workdir, cause, SETTINGS)
        cloud = cloud_of(row, cause, workdir)
        known = truth_of(row, cloud, workdir)
        cloud = cloud.moved(known.world_from_row)
        shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals, SETTINGS)
        main = [stem for stem in shapes.stems if stem.kind == "main"]
        points = places_near_fruit(surface, shapes.tomatoes, main, SETTINGS)
        hanging = [stem for stem in known.row.stems if stem.kind in HANGING]
        labels = distance_to_shapes(points.nodes, hanging).min(axis=1) < NEAR
        petioles = [shape for shape in known.row.clutter if isinstance(shape, Capsule)]
        return cls(shapes.tomatoes, main, points, labels, known.row.stems, visible_of(row, workdir).stems, petioles)

    def colorless(self) -> Places:
        """Return the points as in a cloud of one color."""
        measures = self.points.measures.copy()
        measures[:, PEDUNCLE_COLORS] = 0.0
        return self.points._replace(measures=measures)


# -- fits -------------------------------------------------------------------------------------------------------------


def fit_seeds(parts: Sequence[Labeled]) -> Array:
    """Return logistic weights and offset by ridge regression (Newton's method) on standardized features."""
    features = np.concatenate([part.features for part in parts])[:, : len(MEASURES)]
    labels = np.concatenate([part.labels for part in parts])
    mean, deviation = features.mean(axis=0), features.std(axis=0) + 1e-9
    design = np.column_stack([(features - mean) / deviation, np.ones(len(features))])
    ridge = RIDGE * np.eye(design.shape[1])
    ridge[-1, -1] = 1e-6
    weights = np.zeros(design.shape[1])
    for _ in range(50):
        likely = credibility(design[:, :-1], weights)
        curvature = np.maximum(likely * (1 - likely), 1e-6)
        gradient = design.T @ (labels - likely) - ridge @ weights
        step = np.linalg.solve(design.T @ (curvature[:, None] * design) + ridge, gradient)
        weights = weights + step
        if np.abs(step).max() < 1e-7:
            break
    scaled = weights[:-1] / deviation
    return np.append(scaled, weights[-1] - scaled @ mean)


def fit_large(examples: Sequence[Spheres]) -> Judges:
    """Fit the networks of the first and of the second pass."""
    return Judges(fit_labeled([e.first for e in examples]), fit_labeled([e.second for e in examples]))


def fit_small(examples: Sequence[SmallSpheres]) -> Network:
    """Fit the network to small spheres without context, without color, and in the context of confident ones."""
    first = [part for e in examples for part in (e.labeled([]), e.colorless())]
    network = fit_labeled(first)
    confident = [e.labeled(sure_small(e.small, e.found, SETTINGS, network)) for e in examples]
    return fit_labeled([*first, *confident])


def fit_peduncles(examples: Sequence[Peduncles]) -> tuple[Network, Network]:
    """Fit a network to the points' own features, and one that also knows its scores around them.

    The second learns from scores of rows to which the first was not fitted.
    """
    parts = [part for e in examples for part in (e.points, e.colorless())]
    labels = [e.labels for e in examples for _ in range(2)]
    context = [np.zeros(0)] * len(parts)
    for k in range(FOLDS):
        held = [i for i in range(len(parts)) if i // 2 % FOLDS == k]
        others = [i for i in range(len(parts)) if i not in held]
        first = fit_network([parts[i].measures for i in others], [labels[i] for i in others])
        for i in held:
            context[i] = in_context(parts[i], first(parts[i].measures))
    return fit_network([part.measures for part in parts], labels), fit_network(context, labels)


# -- counts -----------------------------------------------------------------------------------------------------------


def count_large(example: Spheres, networks: Judges) -> Array:
    """Count the tomatoes that networks find among the spheres."""
    return count_tomatoes(example.true, example.visible, large_tomatoes(example.looks, SETTINGS, networks).fits)


def count_small(example: SmallSpheres, network: Network) -> Array:
    """Count the large tomatoes and those that a network adds."""
    found = [*example.found.fits, *chosen_small(example.small, example.found, SETTINGS, network).fits]
    return count_tomatoes(example.true, example.visible, found)


def measure_peduncles(example: Peduncles, networks: tuple[Network, Network]) -> Array:
    """Measure peduncles and pedicels, m: visible, found of these, false."""
    first, second = networks
    points = example.points
    scores, nodes = second(in_context(points, first(points.measures))), points.nodes
    stems = find_peduncles(nodes[scores > SETTINGS.min_peduncle], example.tomatoes, example.main, SETTINGS)
    stems += find_bare_peduncles(nodes[scores > SETTINGS.min_bare_peduncle], [*example.main, *stems], SETTINGS)
    sums = [compare_stems(example.true, example.visible, example.petioles, stems, kind) for kind in HANGING]
    return np.sum([[s.visible, s.found, s.false] for s in sums], axis=0)


def main() -> None:
    """Check by fifths, fit to all rows, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("classifier", choices=("seeds", "large", "small", "peduncles"))
    parser.add_argument("--workdir", type=Path, required=True, help="folder of recordings and clouds")
    parser.add_argument("--own", type=int, nargs="*", default=[302, 303], help="seeds of own rows")
    parser.add_argument("--helios", type=int, nargs="*", default=[*range(501, 507), *DRAWN_MESHES])
    parser.add_argument("--length", type=float, default=1.0, help="of each row, m")
    a = parser.parse_args()
    torch.set_num_threads(1)
    rows = [Row(seed, a.length, source) for source in ("own", "helios") for seed in getattr(a, source)]
    if a.classifier == "seeds":
        np.set_printoptions(precision=4, suppress=True, linewidth=110)
        print(fit_seeds([Spheres.of(row, a.workdir, CAUSES[0]).first for row in rows]))
        return
    examples: list[list[Any]] = []
    for row in rows:
        if a.classifier == "large":
            examples.append([Spheres.of(row, a.workdir, c, shift) for c in causes_of(row) for shift in SHIFTS])
        else:
            kind: Any = SmallSpheres if a.classifier == "small" else Peduncles
            examples.append([kind.of(row, a.workdir, cause) for cause in causes_of(row)])
        print(f"{row.name}: {len(examples[-1])} examples", flush=True)
    every = [example for own in examples for example in own]
    fit, count, names = {
        "large": (fit_large, count_large, ("large_fruit", "large_fruit_beside")),
        "small": (fit_small, count_small, ("small_fruit",)),
        "peduncles": (fit_peduncles, measure_peduncles, ("peduncles", "peduncles_in_context")),
    }[a.classifier]
    counts = cross_validated(examples, fit, count)
    for source in ("own", "helios"):
        sums = [np.sum(own, axis=0) for own, row in zip(counts, rows, strict=True) if row.source == source]
        visible, found, false = np.sum(sums, axis=0) if sums else np.zeros(3)
        print(f"{source}: {found:.4g} of {visible:.4g} found, {false:.4g} false, F1 {f1(visible, found, false):.3f}")
    networks = fit(every)
    for network, name in zip((networks,) if isinstance(networks, Network) else networks, names, strict=True):
        write_network(network, name)


def f1(visible: float, found: float, false: float) -> float:
    """Return the F1 score of counts."""
    return 2 * found / max(visible + found + false, 1e-9)


if __name__ == "__main__":
    main()
