"""Draw how often tomatoes of some confidence are true ones: a curve for each file that shapes.py wrote.

python benchmarks/shapes_calibration.py benchmarks/results/shapes_helios.json benchmarks/results/shapes.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib as mpl
from results_file import RESULTS

mpl.use("Agg")
import matplotlib.pyplot as plt


def main() -> None:
    """Read the files, draw the curves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=RESULTS / "shapes_calibration.png")
    arguments = parser.parse_args()
    figure, axes = plt.subplots(figsize=(4, 4), dpi=110)
    axes.plot([0, 1], [0, 1], color="0.7")
    for file in arguments.files:
        known = json.loads(file.read_text())["figures"]["noisy"]["calibration"]
        middles = [(a + b) / 2 for a, b in zip(known["edges"], known["edges"][1:], strict=False)]
        kept = [k for k, count in enumerate(known["counts"]) if count]
        axes.plot([middles[k] for k in kept], [known["true"][k] for k in kept], "o-", label=file.stem)
        for k in kept:
            axes.annotate(str(known["counts"][k]), (middles[k], known["true"][k]), fontsize=7)
    axes.set(xlabel="confidence", ylabel="share that is true", xlim=(0, 1), ylim=(0, 1.05))
    axes.legend(loc="upper left")
    figure.tight_layout()
    figure.savefig(arguments.out)


if __name__ == "__main__":
    main()
