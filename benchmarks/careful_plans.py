"""Do plans made on the scenes of a bank hold in the rows they were scanned from?

    python benchmarks/careful_plans.py --split train --per-scene 5                  # development
    python benchmarks/careful_plans.py --split validation test --out benchmarks/results/careful_plans.json

In each scene tomatoes within reach are planned for on the reconstruction, by each way to treat unknown space, and the
path is followed in the truth. The bank's rows are those the package ships, so nothing is photographed or reconstructed.
Episodes are kept under --workdir scene by scene, so an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
from itertools import product
from pathlib import Path
from typing import Any

from capture_protocols import reach_in
from capture_protocols_rows import Options
from capture_protocols_summary import summaries, table
from results_file import write_results

from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.scene import SceneBank


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", default="default")
    parser.add_argument("--split", nargs="+", default=["train"])
    parser.add_argument("--starts", nargs="+", default=["folded"], help="what the arm starts from: start, folded")
    parser.add_argument("--unknown", nargs="+", default=["0.15", "free"], help="free, avoid, forbid, or a depth")
    parser.add_argument("--planner", default="RRTConnect")
    parser.add_argument("--checks", type=int, default=10_000, help="collision checks of a plan")
    parser.add_argument("--margin", type=float, default=0.01, help="how far paths keep from boxes of leaves, metres")
    parser.add_argument("--unexplained", action="store_true", help="keep out of seen surfaces that have no shape")
    parser.add_argument("--per-scene", type=int, default=50, help="most targets of a scene")
    parser.add_argument("--moved", action="store_true", help="follow in plants that moved since they were scanned")
    parser.add_argument("--workdir", type=Path, default=Path("careful_plans"))
    parser.add_argument("--only-finished", action="store_true", help="measure nothing, tell what is there")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    a = parser.parse_args()
    options = Options(
        planner=a.planner,
        checks=a.checks,
        per_scene=a.per_scene,
        moved=a.moved,
        margin=a.margin,
        unexplained=a.unexplained,
        workdir=a.workdir / a.bank,
    )
    bank = SceneBank.open(a.bank)
    names = [name for split in a.split for name in bank.names(split)]
    episodes: list[dict[str, Any]] = []
    for unknown, start, name in product(a.unknown, a.starts, names):
        file = file_of(name, start, unknown, options)
        if not file.exists():
            if a.only_finished:
                continue
            write_atomically(file, json.dumps(_measured(bank, name, start, unknown, options)))
            print(f"{name}, {start}, {unknown}", flush=True)
        episodes += json.loads(file.read_text())
    print(table(summaries(episodes)))
    if a.out:
        command = (
            f"benchmarks/careful_plans.py --bank {a.bank} --split {' '.join(a.split)} --starts {' '.join(a.starts)} "
            f"--unknown {' '.join(a.unknown)} --planner {a.planner} --checks {a.checks} --margin {a.margin:g} "
            f"--per-scene {a.per_scene}{' --unexplained' * a.unexplained}{' --moved' * a.moved}"
            f"{' --only-finished' * a.only_finished}"
        )
        scenes = sorted({episode["scene"] for episode in episodes})
        figures = {"command": command, "scenes_measured": scenes, "figures": summaries(episodes)}
        write_results(a.out, figures, ["mujoco", "ompl"])


def file_of(name: str, start: str, unknown: str, options: Options) -> Path:
    """Where the episodes of a scene are kept."""
    how = f"{start}-{unknown}-{options.margin:g}" + "-unexplained" * options.unexplained + "-moved" * options.moved
    return options.workdir / name / f"{options.planner}-{options.checks}-{options.per_scene}-{how}.json"


def _measured(bank: SceneBank, name: str, start: str, unknown: str, options: Options) -> list[dict[str, Any]]:
    scene = bank.scene(name)
    known = scene.provenance
    about = {
        "source": known.source or "own", "row": known.row, "protocol": known.protocol or "paper", "unknown": unknown,
        "start": start,
    }  # fmt: skip
    return [about | episode for episode in reach_in([scene], unknown, start, 0, options)]


if __name__ == "__main__":
    main()
