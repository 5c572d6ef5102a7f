"""Helpers for fitting classifiers of shape extraction: rows, labels, networks, checks on rows left out of the fit."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import torch

from benchmarks.sensing.rows import CAUSES, Row, cloud_of, truth_of
from greenhouse_gym.accuracy import Visibility, compare_tomatoes
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Array, Sphere
from greenhouse_gym.geometry.point_clouds import Cloud
from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.input_checks import WarningLog, downsample
from greenhouse_gym.shapes.networks import Network, network_file
from greenhouse_gym.shapes.surface_cloud import SurfaceCloud, fine_surface, measure_surface

HIDDEN, STEPS, BATCH, RATE, DECAY = 64, 3000, 4096, 5e-3, 0.3
FOLDS = 5
"""Parts of the rows; each is checked with classifiers that were fitted to the others."""

Fitted = TypeVar("Fitted")


class Surfaces(NamedTuple):
    """A row's cloud in the world, its surface with a point per voxel and per fine voxel, and the true row."""

    cloud: Cloud
    surface: SurfaceCloud
    fine: SurfaceCloud
    true: PlantRow


class Labeled(NamedTuple):
    """Features (k, m) of candidates, and labels (k,): whether each is fruit."""

    features: Array
    labels: npt.NDArray[np.bool_]


def label_spheres(spheres: Sequence[Sphere], features: Array, true: Sequence[Tomato]) -> Labeled:
    """Label spheres: fruit has its center within half a radius of a tomato's and its size within a third.

    Spheres that are nearly right are left out.
    """
    centers, radii = np.array([t.center for t in true]), np.array([t.radius for t in true])
    away = np.linalg.norm(np.array([s.center for s in spheres]).reshape(-1, 1, 3) - centers, axis=-1) / radii
    nearest = away.argmin(axis=1)
    away = away[np.arange(len(spheres)), nearest]
    sized = np.abs(np.log(np.array([s.radius for s in spheres]) / radii[nearest])) < 0.35
    clear = ~(sized & (away >= 0.5) & (away < 1.0))
    return Labeled(features[clear], (sized & (away < 0.5))[clear])


def causes_of(row: Row) -> tuple[str, ...]:
    """Return the clouds of a row to which classifiers are fitted: only noisy ones of random cultivars."""
    return CAUSES[:1] if row.style == "drawn" else CAUSES


def surfaces_of(row: Row, workdir: Path, cause: str, settings: ShapeSettings) -> Surfaces:
    """Return the surfaces of one of a row's clouds."""
    in_row = cloud_of(row, cause, workdir)
    known = truth_of(row, in_row, workdir)
    cloud = in_row.transformed(known.world_from_row)
    surface = measure_surface(downsample(cloud, True, settings, WarningLog()))
    return Surfaces(cloud, surface, fine_surface(cloud, surface, settings), known.row)


def fit_network(features: Sequence[Array], labels: Sequence[Array]) -> Network:
    """Fit a network by cross entropy on standardized features; the parts are joined."""
    joined, right = np.concatenate(features), np.concatenate(labels)
    center, scale = joined.mean(axis=0), joined.std(axis=0) + 1e-9
    inputs = torch.tensor((joined - center) / scale, dtype=torch.float32)
    wanted = torch.tensor(right, dtype=torch.float32)
    torch.manual_seed(0)
    hidden, out = torch.nn.Linear(inputs.shape[1], HIDDEN), torch.nn.Linear(HIDDEN, 1)
    network = torch.nn.Sequential(hidden, torch.nn.Tanh(), out)
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    for _ in range(STEPS):
        batch = torch.randint(len(inputs), (BATCH,))
        loss = torch.nn.functional.binary_cross_entropy_with_logits(network(inputs[batch])[:, 0], wanted[batch])
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    layers = (hidden.weight.T, hidden.bias, out.weight[0], out.bias)
    return Network(center, scale, *(layer.detach().double().numpy() for layer in layers))


def fit_labeled(parts: Sequence[Labeled]) -> Network:
    """Fit a network to labeled candidates."""
    return fit_network([part.features for part in parts], [part.labels for part in parts])


def write_network(network: Network, name: str) -> None:
    """Write a network to five digits in the package."""
    stored = {key: [float(f"{v:.5g}") for v in np.ravel(values)] for key, values in asdict(network).items()}
    stored["hidden"] = np.reshape(stored["hidden"], network.hidden.shape).tolist()
    lines = ",\n".join(f' "{key}": {json.dumps(values)}' for key, values in stored.items())
    write_atomically(network_file(name), "{\n" + lines + "\n}\n")


def count_tomatoes(true: Sequence[Tomato], visible: Visibility, found: Sequence[Sphere]) -> npt.NDArray[np.int64]:
    """Count the visible tomatoes of a row, those of them that were found, and false ones."""
    result = compare_tomatoes(true, visible, [Tomato(sphere, 0) for sphere in found])
    return np.array([len(result.found), np.count_nonzero(result.found), len(result.false)])


def cross_validated(
    rows: Sequence[Sequence[Any]], fit: Callable[[list[Any]], Fitted], count: Callable[[Any, Fitted], Array]
) -> list[list[Array]]:
    """Count on every example of every row what classifiers find that were fitted to the other folds.

    Args:
        rows: Examples of each row.
        fit: Fits classifiers to examples.
        count: Counts on an example what classifiers find.
    """
    counts: list[list[Array]] = [[] for _ in rows]
    for k in range(min(FOLDS, len(rows))):
        classifiers = fit([example for i, row in enumerate(rows) if i % FOLDS != k for example in row])
        for i in range(k, len(rows), FOLDS):
            counts[i] = [count(example, classifiers) for example in rows[i]]
    return counts
