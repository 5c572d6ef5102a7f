"""Is the default bank whole, every witness replayed, and how soon is it open and a first environment reset.

python benchmarks/bank_check.py

Opening, and the first environment with its reset, are each measured in processes of their own that have imported the
package, several times; seconds of the wall depend on what else the machine does, those of the processor hardly.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

from results_file import RESULTS, write_results

from greenhouse_gym.planning.audit import bank_faults
from greenhouse_gym.scene import SceneBank

CODE = """
import time
import gymnasium, greenhouse_gym
from greenhouse_gym.scene import SceneBank
began = time.perf_counter(), time.process_time()
{}
print(time.perf_counter() - began[0], time.process_time() - began[1])
"""
ACTS = {
    "open": 'SceneBank.open("default")',
    "first make and reset": 'gymnasium.make("TomatoReach-v0").reset(seed=0)',
}


def main() -> None:
    """Measure, check and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=5)
    parser.add_argument("--out", type=Path, default=RESULTS / "bank_check.json")
    arguments = parser.parse_args()
    result: dict[str, object] = {name: seconds_of(act, arguments.times) for name, act in ACTS.items()}
    print(result, flush=True)
    bank = SceneBank.open("default")
    witnesses = sum(target.witness is not None for scene in bank for target in scene.targets)
    began = time.process_time(), time.perf_counter()
    faults = list(bank_faults(bank))
    result["check"] = {
        "scenes": len(bank),
        "sha256": bank.sha256,
        "witnesses replayed": witnesses,
        "faults": faults,
        "processor s": round(time.process_time() - began[0]),
        "wall s": round(time.perf_counter() - began[1]),
    }
    result["load at the end"] = round(os.getloadavg()[0], 2)
    print(result)
    write_results(
        arguments.out, {"command": f"benchmarks/bank_check.py --times {arguments.times}", **result}, ["mujoco"]
    )


def seconds_of(act: str, times: int) -> dict[str, float]:
    """Medians of wall and processor time of some code in fresh processes."""
    runs = [
        [float(word) for word in subprocess.check_output([sys.executable, "-c", CODE.format(act)], text=True).split()]
        for _ in range(times)
    ]
    wall, processor = zip(*runs, strict=True)
    return {
        "wall s": round(median(wall), 3),
        "wall s at best": round(min(wall), 3),
        "processor s": round(median(processor), 3),
    }


if __name__ == "__main__":
    main()
