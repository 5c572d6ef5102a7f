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

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from fit_credibility import Labeled, labeled, surfaces_of
from shape_rows import CAUSES, DRAWN_MESHES, Row, visible_of

from greenhouse_gym.accuracy import Visibility, compare_tomatoes
from greenhouse_gym.crop import Tomato
from greenhouse_gym.paths import write_atomically
from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.candidates import COMPANY, MEASURES
from greenhouse_gym.shapes.credibility import SMALL_FRUIT, Network
from greenhouse_gym.shapes.small_fruit import Credited, Small, chosen_small, small_spheres, sure_small
from greenhouse_gym.shapes.tomatoes import large_tomatoes, look

HIDDEN, STEPS, BATCH, RATE, DECAY = 64, 3000, 4096, 5e-3, 0.3
FIFTHS = 5
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


def causes_of(row: Row) -> tuple[str, ...]:
    """Which clouds of a row are fitted to: of drawn cultivars the noisy ones alone, since plants take long to grow."""
    return CAUSES[:1] if row.style == "drawn" else CAUSES


def looked_at(row: Row, workdir: Path, cause: str) -> Looked:
    """Look at a row's cloud of one of the `CAUSES`."""
    surface, fine, true = surfaces_of(row, workdir, cause)
    found = large_tomatoes(look(surface, SETTINGS), SETTINGS)
    return Looked(found, small_spheres(fine, SETTINGS), true, visible_of(row, workdir).tomatoes)


def fitted(rows: Sequence[Looked]) -> Network:
    """The network that learned both judgements from rows."""
    first = [part for row in rows for part in (row.beside([]), _colorless(row))]
    judge = _trained(first)
    return _trained([*first, *(row.beside(sure_small(row.small, row.found, SETTINGS, judge)) for row in rows)])


def _colorless(row: Looked) -> Labeled:
    """The measures of a row's small spheres as in a cloud of one color that holds no other fruit."""
    alone = row.small.alone.copy()
    alone[:, [MEASURES.index(name) for name in ("contrast", "tone spread")]] = 0.0
    company = np.zeros((len(alone), len(COMPANY)))
    return labeled(row.small.fits, np.column_stack([alone, company]), row.true)


def _trained(parts: Sequence[Labeled]) -> Network:
    """A network by cross entropy on standardized measures."""
    measures = np.concatenate([part.measures for part in parts])
    right = torch.tensor(np.concatenate([part.right for part in parts]), dtype=torch.float32)
    center, scale = measures.mean(axis=0), measures.std(axis=0) + 1e-9
    inputs = torch.tensor((measures - center) / scale, dtype=torch.float32)
    torch.manual_seed(0)
    hidden, out = torch.nn.Linear(inputs.shape[1], HIDDEN), torch.nn.Linear(HIDDEN, 1)
    network = torch.nn.Sequential(hidden, torch.nn.Tanh(), out)
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    for _ in range(STEPS):
        batch = torch.randint(len(inputs), (BATCH,))
        loss = torch.nn.functional.binary_cross_entropy_with_logits(network(inputs[batch])[:, 0], right[batch])
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    layers = (hidden.weight.T, hidden.bias, out.weight[0], out.bias)
    return Network(center, scale, *(layer.detach().double().numpy() for layer in layers))


def counted(row: Looked, network: Network | None) -> np.ndarray:
    """How many tomatoes of a row could be seen, were found of these, and were found where there are none."""
    found = list(row.found.fits)
    if network is not None:
        found += chosen_small(row.small, row.found, SETTINGS, network).fits
    result = compare_tomatoes(row.true, row.visible, [Tomato(f.center, f.radius, 0, 0.0) for f in found])
    return np.array([len(result.found), np.count_nonzero(result.found), len(result.false)])


def main() -> None:
    """Check by fifths, fit to all, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workdir", type=Path, required=True)
    parser.add_argument("--own", type=int, nargs="*", default=[302, 303])
    parser.add_argument("--helios", type=int, nargs="*", default=[*range(501, 507), *DRAWN_MESHES])
    parser.add_argument("--length", type=float, default=1.0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, Looked]] = []
    for source, seeds in (("own", arguments.own), ("helios", arguments.helios)):
        for seed in seeds:
            row = Row(seed, arguments.length, source)
            rows.append({cause: looked_at(row, arguments.workdir, cause) for cause in causes_of(row)})
            print(row.name, [len(looked.small.fits) for looked in rows[-1].values()], "small spheres", flush=True)
    with_it = dict.fromkeys(CAUSES, np.zeros(3, dtype=int))
    for k in range(FIFTHS):
        network = fitted([looked for i, row in enumerate(rows) if i % FIFTHS != k for looked in row.values()])
        for row in rows[k::FIFTHS]:
            for cause, looked in row.items():
                with_it[cause] = with_it[cause] + counted(looked, network)
    for cause in CAUSES:
        without = np.sum([counted(row[cause], None) for row in rows if cause in row], axis=0)
        for name, (visible, found, false) in (("without", without), ("with", with_it[cause])):
            f1 = 2 * found / (visible + found + false)
            print(f"{cause}, {name}: {found} of {visible} found, {false} false, F1 {f1:.3f}")
    network = fitted([looked for row in rows for looked in row.values()])
    stored = {name: [float(f"{v:.5g}") for v in np.ravel(values)] for name, values in asdict(network).items()}
    stored["hidden"] = np.reshape(stored["hidden"], network.hidden.shape).tolist()
    lines = ",\n".join(f' "{name}": {json.dumps(values)}' for name, values in stored.items())
    write_atomically(SMALL_FRUIT, "{\n" + lines + "\n}\n")


if __name__ == "__main__":
    main()
