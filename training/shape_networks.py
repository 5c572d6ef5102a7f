"""Fit the classifiers of shape extraction to simulated rows, after checking them on rows left out of the fit.

python -m training.shape_networks large --workdir rows

``seeds`` prints the logistic weights that select confident fruit of the first pass, for ``fruit/large_fruit.py``;
``large`` fits the networks that score spheres of the first and second pass, ``small`` the one for small spheres,
``peduncles`` the two for points on peduncles and pedicels. Rows are development rows of both sources and rows of random
cultivars; none is held out. Development rows are also seen in perfect images, since other cameras have less noise. By
fifths of the rows the networks are fitted to the others and what they find is compared with the truth; then they are
fitted to all rows and written into the package. Takes one to three hours, most of it for rows that are not yet in
--workdir.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.sensing.rows import CAUSES, DRAWN_MESHES, Row, visible_of
from greenhouse_gym.accuracy import Visibility, compare_stems
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Array, Capsule, distance_to_shapes
from greenhouse_gym.shapes import ShapeSettings, extract_shapes
from greenhouse_gym.shapes.fruit.large_fruit import (
    Candidates,
    ScoredFruit,
    SphereClassifiers,
    fit_candidates,
    large_fruit,
    logistic,
)
from greenhouse_gym.shapes.fruit.small_fruit import SmallSpheres, confident_small, select_small, small_spheres
from greenhouse_gym.shapes.fruit.sphere_features import COLOR_FEATURES, CONTEXT_FEATURES, SPHERE_FEATURES
from greenhouse_gym.shapes.networks import Network
from greenhouse_gym.shapes.stems import peduncle_features
from greenhouse_gym.shapes.stems.peduncle_features import PeduncleCandidates, peduncle_candidates
from greenhouse_gym.shapes.stems.traced_peduncles import trace_peduncles, with_context
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
RIDGE = 2.0
HANGING = ("peduncle", "pedicel")
NEAR = 0.002  # metres


class LargeExample(NamedTuple):
    """Spheres of the first two passes on a row with labels, and the truth."""

    candidates: Candidates
    first: Labeled
    second: Labeled
    true: Sequence[Tomato]
    visible: Visibility

    @classmethod
    def of(cls, row: Row, workdir: Path, cause: str) -> LargeExample:
        """Fit the spheres of both passes to one of a row's clouds."""
        surfaces = surfaces_of(row, workdir, cause, SETTINGS)
        candidates, true = fit_candidates(surfaces.surface, SETTINGS), surfaces.true.tomatoes
        first = label_spheres(candidates.first, candidates.first_features, true)
        second = label_spheres(candidates.second, candidates.second_features, true)
        return cls(candidates, first, second, true, visible_of(row, workdir).tomatoes)


class SmallExample(NamedTuple):
    """Small spheres of a row, the large tomatoes found in it, and the truth."""

    found: ScoredFruit
    small: SmallSpheres
    true: Sequence[Tomato]
    visible: Visibility

    @classmethod
    def of(cls, row: Row, workdir: Path, cause: str) -> SmallExample:
        """Fit small spheres to one of a row's clouds."""
        surfaces = surfaces_of(row, workdir, cause, SETTINGS)
        found = large_fruit(fit_candidates(surfaces.surface, SETTINGS), SETTINGS)
        small, visible = small_spheres(surfaces.fine, SETTINGS), visible_of(row, workdir).tomatoes
        return cls(found, small, surfaces.true.tomatoes, visible)

    def labeled(self, chosen: Sequence[int]) -> Labeled:
        """Return the small spheres in the context of the chosen ones, with labels."""
        return label_spheres(self.small.fits, self.small.with_context(self.found, chosen), self.true)

    def colorless(self) -> Labeled:
        """Return the small spheres as in a cloud of one color without other fruit, with labels."""
        own = self.small.features.copy()
        own[:, [SPHERE_FEATURES.index(name) for name in ("contrast", "hue spread")]] = 0.0
        own[:, len(SPHERE_FEATURES) + np.array(COLOR_FEATURES)] = 0.0
        features = np.column_stack([own, np.zeros((len(own), len(CONTEXT_FEATURES)))])
        return label_spheres(self.small.fits, features, self.true)


class PeduncleExample(NamedTuple):
    """Candidate points of peduncles with labels (n,), the tomatoes and main stems found in the row, and the truth."""

    tomatoes: tuple[Tomato, ...]
    main: list[Stem]
    candidates: PeduncleCandidates
    labels: Array
    true: Sequence[Stem]
    visible: Sequence[Stem]
    petioles: Sequence[Capsule]

    @classmethod
    def of(cls, row: Row, workdir: Path, cause: str) -> PeduncleExample:
        """Find the candidate points in one of a row's clouds."""
        cloud, surface, _, true = surfaces_of(row, workdir, cause, SETTINGS)
        shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals, SETTINGS)
        main = [stem for stem in shapes.stems if stem.kind == "main"]
        candidates = peduncle_candidates(surface, shapes.tomatoes, main)
        hanging = [stem for stem in true.stems if stem.kind in HANGING]
        labels = distance_to_shapes(candidates.nodes, hanging).min(axis=1) < NEAR
        petioles = [shape for shape in true.clutter if isinstance(shape, Capsule)]
        visible = visible_of(row, workdir).stems
        return cls(shapes.tomatoes, main, candidates, labels, true.stems, visible, petioles)

    def colorless(self) -> PeduncleCandidates:
        """Return the candidates as in a cloud of one color."""
        features = self.candidates.features.copy()
        features[:, peduncle_features.COLOR_FEATURES] = 0.0
        return self.candidates._replace(features=features)


# -- fits -------------------------------------------------------------------------------------------------------------


def fit_seeds(parts: Sequence[Labeled]) -> Array:
    """Return logistic weights and offset by ridge regression (Newton's method) on standardized features."""
    features = np.concatenate([part.features for part in parts])[:, : len(SPHERE_FEATURES)]
    labels = np.concatenate([part.labels for part in parts])
    mean, deviation = features.mean(axis=0), features.std(axis=0) + 1e-9
    design = np.column_stack([(features - mean) / deviation, np.ones(len(features))])
    ridge = RIDGE * np.eye(design.shape[1])
    ridge[-1, -1] = 1e-6
    weights = np.zeros(design.shape[1])
    for _ in range(50):
        likely = logistic(design[:, :-1], weights)
        curvature = np.maximum(likely * (1 - likely), 1e-6)
        gradient = design.T @ (labels - likely) - ridge @ weights
        step = np.linalg.solve(design.T @ (curvature[:, None] * design) + ridge, gradient)
        weights = weights + step
        if np.abs(step).max() < 1e-7:
            break
    scaled = weights[:-1] / deviation
    return np.append(scaled, weights[-1] - scaled @ mean)


def fit_large(examples: Sequence[LargeExample]) -> SphereClassifiers:
    """Fit the networks of the first and of the second pass."""
    return SphereClassifiers(fit_labeled([e.first for e in examples]), fit_labeled([e.second for e in examples]))


def fit_small(examples: Sequence[SmallExample]) -> tuple[Network]:
    """Fit the network to small spheres without context, without color, and in the context of confident ones."""
    first = [part for e in examples for part in (e.labeled([]), e.colorless())]
    network = fit_labeled(first)
    confident = [e.labeled(confident_small(e.small, e.found, network)) for e in examples]
    return (fit_labeled([*first, *confident]),)


def fit_peduncles(examples: Sequence[PeduncleExample]) -> tuple[Network, Network]:
    """Fit a network to the points' own features, and one that also gets its scores around them.

    The second is fitted to scores of examples to which the first was not fitted.
    """
    parts = [part for e in examples for part in (e.candidates, e.colorless())]
    labels = [e.labels for e in examples for _ in range(2)]
    context = [np.zeros(0)] * len(parts)
    for k in range(min(FOLDS, len(examples))):
        held = [i for i in range(len(parts)) if i // 2 % FOLDS == k]
        others = [i for i in range(len(parts)) if i not in held]
        first = fit_network([parts[i].features for i in others], [labels[i] for i in others])
        for i in held:
            context[i] = with_context(parts[i], first(parts[i].features))
    return fit_network([part.features for part in parts], labels), fit_network(context, labels)


# -- counts -----------------------------------------------------------------------------------------------------------


def count_large(example: LargeExample, networks: SphereClassifiers) -> Array:
    """Count the tomatoes that networks find among the spheres."""
    return count_tomatoes(example.true, example.visible, large_fruit(example.candidates, SETTINGS, networks).fits)


def count_small(example: SmallExample, networks: tuple[Network]) -> Array:
    """Count the large tomatoes and those that a network adds."""
    found = [*example.found.fits, *select_small(example.small, example.found, SETTINGS, networks[0]).fits]
    return count_tomatoes(example.true, example.visible, found)


def measure_peduncles(example: PeduncleExample, networks: tuple[Network, Network]) -> Array:
    """Measure peduncles and pedicels, metres: visible, found of these, false."""
    first, second = networks
    candidates, tolerance = example.candidates, SETTINGS.axis_tolerance
    scores = second(with_context(candidates, first(candidates.features)))
    stems = trace_peduncles(candidates.nodes, scores, example.tomatoes, example.main, tolerance)
    sums = [compare_stems(example.true, example.visible, example.petioles, stems, kind) for kind in HANGING]
    return np.sum([[s.visible, s.found, s.false] for s in sums], axis=0)


class Stage(NamedTuple):
    """Examples of a stage of shape extraction, the fit and check of its networks, and their names."""

    example: Any
    fit: Any
    count: Any
    names: tuple[str, ...]


STAGES = {
    "large": Stage(LargeExample, fit_large, count_large, ("fruit/first_pass", "fruit/second_pass")),
    "small": Stage(SmallExample, fit_small, count_small, ("fruit/small_fruit",)),
    "peduncles": Stage(
        PeduncleExample, fit_peduncles, measure_peduncles, ("stems/peduncles", "stems/peduncles_in_context")
    ),
}


def main() -> None:
    """Check by fifths, fit to all rows, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", choices=("seeds", *STAGES))
    parser.add_argument("--workdir", type=Path, required=True, help="folder of recordings and clouds")
    parser.add_argument("--own", type=int, nargs="*", default=[302, 303], help="seeds of own rows")
    parser.add_argument("--helios", type=int, nargs="*", default=[*range(501, 507), *DRAWN_MESHES])
    parser.add_argument("--length", type=float, default=1.0, help="of each row, metres")
    a = parser.parse_args()
    torch.set_num_threads(1)
    rows = [Row(seed, a.length, source) for source in ("own", "helios") for seed in getattr(a, source)]
    if a.stage == "seeds":
        np.set_printoptions(precision=4, suppress=True, linewidth=110)
        print(fit_seeds([LargeExample.of(row, a.workdir, CAUSES[0]).first for row in rows]))
        return
    stage = STAGES[a.stage]
    examples: list[list[Any]] = []
    for row in rows:
        examples.append([stage.example.of(row, a.workdir, cause) for cause in causes_of(row)])
        print(f"{row.name}: {len(examples[-1])} examples", flush=True)
    counts = cross_validated(examples, stage.fit, stage.count)
    for source in ("own", "helios"):
        sums = [np.sum(own, axis=0) for own, row in zip(counts, rows, strict=True) if row.source == source]
        visible, found, false = np.sum(sums, axis=0) if sums else np.zeros(3)
        print(f"{source}: {found:.4g} of {visible:.4g} found, {false:.4g} false, F1 {f1(visible, found, false):.3f}")
    networks = stage.fit([example for own in examples for example in own])
    for network, name in zip(networks, stage.names, strict=True):
        write_network(network, name)


def f1(visible: float, found: float, false: float) -> float:
    """Return the F1 score of counts."""
    return 2 * found / max(visible + found + false, 1e-9)


if __name__ == "__main__":
    main()
