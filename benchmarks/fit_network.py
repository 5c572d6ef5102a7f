"""What the scripts that fit networks share: the rows, and a network that is fitted to them and written."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from fit_credibility import Labeled
from shape_rows import CAUSES, DRAWN_MESHES, Row

from greenhouse_gym.accuracy import Visibility, compare_tomatoes
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.shapes.networks import Network

HIDDEN, STEPS, BATCH, RATE, DECAY = 64, 3000, 4096, 5e-3, 0.3
FIFTHS = 5
"""Parts of the rows; each is checked with a network that was fitted to the others."""


def rows_to_fit(description: str | None) -> tuple[list[Row], Path]:
    """The rows that the command line names, and the folder with what was made of them."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workdir", type=Path, required=True)
    parser.add_argument("--own", type=int, nargs="*", default=[302, 303])
    parser.add_argument("--helios", type=int, nargs="*", default=[*range(501, 507), *DRAWN_MESHES])
    parser.add_argument("--length", type=float, default=1.0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    seeds = {"own": arguments.own, "helios": arguments.helios}
    return [Row(seed, arguments.length, source) for source in seeds for seed in seeds[source]], arguments.workdir


def causes_of(row: Row) -> tuple[str, ...]:
    """Which clouds of a row are fitted to: of drawn cultivars the noisy ones alone, since plants take long to grow."""
    return CAUSES[:1] if row.style == "drawn" else CAUSES


def fitted_network(measures: np.ndarray, right: np.ndarray) -> Network:
    """A network by cross entropy on standardized measures (k, m) and which of them (k,) are right."""
    center, scale = measures.mean(axis=0), measures.std(axis=0) + 1e-9
    inputs = torch.tensor((measures - center) / scale, dtype=torch.float32)
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


def learned(parts: Sequence[Labeled]) -> Network:
    """A network that learned from all of these."""
    return fitted_network(np.concatenate([p.measures for p in parts]), np.concatenate([p.right for p in parts]))


def count_tomatoes(true: Sequence[Tomato], visible: Visibility, found: Sequence[Sphere]) -> np.ndarray:
    """How many tomatoes of a row could be seen, were found of these, and were found where there are none."""
    result = compare_tomatoes(true, visible, [Tomato(Sphere(f.center, f.radius), 0, 0.0) for f in found])
    return np.array([len(result.found), np.count_nonzero(result.found), len(result.false)])


def print_counts(counts: Mapping[str, np.ndarray]) -> None:
    """Print sums of `count_tomatoes` by name, with F1."""
    for name, (visible, found, false) in counts.items():
        f1 = 2 * found / (visible + found + false)
        print(f"{name}: {found} of {visible} found, {false} false, F1 {f1:.3f}")


def write_network(network: Network, path: Path) -> None:
    """Write a network to five digits."""
    stored = {name: [float(f"{v:.5g}") for v in np.ravel(values)] for name, values in asdict(network).items()}
    stored["hidden"] = np.reshape(stored["hidden"], network.hidden.shape).tolist()
    lines = ",\n".join(f' "{name}": {json.dumps(values)}' for name, values in stored.items())
    write_atomically(path, "{\n" + lines + "\n}\n")
