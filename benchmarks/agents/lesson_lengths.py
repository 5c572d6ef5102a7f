"""Train as ``greenhouse-gym train ppo --backend warp`` does, and keep the policy of each of some processor times.

python -m benchmarks.agents.lesson_lengths --minutes 1 5 30 --seeds 0 1 2
python -m benchmarks.agents.cells runs/lesson_lengths/*.json

Trains with tip actions on all targets of all training rows, by the Warp kernels, on one core. `cells` measures the
policies.
"""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.common import RESULTS, parser, read_entry, write_entry
from greenhouse_gym.common.settings_files import resolve
from greenhouse_gym.learning import DevicePpoSettings
from greenhouse_gym.learning.device_ppo import DevicePpo

RECIPE = DevicePpoSettings(action="tip_velocity")
RESULT = RESULTS / "lesson_lengths.json"


def main() -> None:
    """Train, and write the curves."""
    command = parser(__doc__)
    command.add_argument("--minutes", type=float, nargs="+", default=[1, 5, 30], help="of processor time, ascending")
    command.add_argument("--seeds", type=int, nargs="+", default=[0])
    command.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="setting of the training")
    command.add_argument("--folder", type=Path, default=Path("runs/lesson_lengths"))
    command.add_argument("--name", default="30 minutes", help="of the entry in the file of results")
    a = command.parse_args()
    torch.set_num_threads(1)
    recipe = resolve(RECIPE, None, a.set)
    about = {"settings": asdict(recipe)}
    for seed in a.seeds:
        curve = trained(replace(recipe, seed=seed), a.minutes, a.folder)
        figures = about | {"seeds": {}} | read_entry(RESULT, a.name, about)
        figures["seeds"][str(seed)] = curve
        write_entry(RESULT, a.name, figures)


def trained(settings: DevicePpoSettings, minutes: list[float], folder: Path) -> list[dict[str, Any]]:
    """Train until the last of the times, save a policy at each, and return the curve."""
    training, curve, left = DevicePpo(settings), list[dict[str, Any]](), list(minutes)
    began = time.process_time()
    while left:
        passed = (time.process_time() - began) / 60
        training.iterate(max(0.0, 1 - passed / minutes[-1]))
        if passed > len(curve) * minutes[-1] / 60:
            curve.append({"steps": training.steps, "minutes": round(passed, 2), **training.figures()})
            print(settings.seed, curve[-1], f"rate {training.learning_rate:.1e}", flush=True)
        if passed > left[0]:
            training.policy().save(folder / f"seed-{settings.seed}-{left.pop(0):g}-minutes")
    training.env.close()
    return curve


if __name__ == "__main__":
    main()
