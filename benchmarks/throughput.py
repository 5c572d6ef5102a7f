"""How many environment steps per second: the vector environment, the bare physics under it, and the single environment.

python benchmarks/throughput.py --bank default

All three act at random on scenes of one bank, in turns, so that whatever else the machine does falls on all alike. The
bare physics are `Batch.step` over the same models with the same commands: no contacts read, nothing observed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from results_file import RESULTS, write_results
from rich.console import Console
from rich.table import Table

from greenhouse_gym.envs import TomatoReachEnv, TomatoReachVectorEnv
from greenhouse_gym.envs.reach_task import ACTION_STEP, SUBSTEPS

ROUNDS, STEPS = 8, 40


def rate(steps: int, act: Callable[[], None]) -> float:
    """Steps per second of something that does so many."""
    began = time.perf_counter()
    act()
    return steps / (time.perf_counter() - began)


def measure(bank: str, split: str, count: int, threads: int) -> dict[str, list[float]]:
    """Rates of every round, by what was measured."""
    random = np.random.default_rng(0)
    actions = random.uniform(-1, 1, (STEPS, count, 6))
    vector = TomatoReachVectorEnv(count, bank=bank, split=split, autoreset_mode="SameStep", threads=threads)
    single = TomatoReachEnv(bank=bank, split=split)
    vector.reset(seed=0)  # compiles scenes, which is not measured
    single.reset(seed=0)
    batch = vector.simulation._batch
    assert batch is not None
    controls, joints = batch.bind("ctrl"), batch.bind("qpos")

    def step_vector() -> None:
        for action in actions:
            vector.step(action)

    def step_bare() -> None:
        for action in actions:
            controls[:] = joints + ACTION_STEP * action
            batch.step(nstep=SUBSTEPS)

    def step_single() -> None:
        for action in actions[:, 0]:
            *_, terminated, truncated, _ = single.step(action)
            if terminated or truncated:
                single.reset()

    rates: dict[str, list[float]] = {"vector environment": [], "bare Batch.step": [], "single environment": []}
    for _ in range(ROUNDS):
        vector.reset(seed=0)
        rates["bare Batch.step"].append(rate(count * STEPS, step_bare))
        vector.reset(seed=0)
        rates["vector environment"].append(rate(count * STEPS, step_vector))
        rates["single environment"].append(rate(STEPS, step_single))
    return rates


def main() -> None:
    """Measure, print a table and write it down with versions and machine."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", default="default")
    parser.add_argument("--split", default="train")
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS / "throughput.json")
    arguments = parser.parse_args()
    rates = measure(arguments.bank, arguments.split, arguments.num_envs, arguments.threads)
    medians = {name: float(np.median(values)) for name, values in rates.items()}
    shares = np.array(rates["vector environment"]) / np.array(rates["bare Batch.step"])
    table = Table("what", "steps/s (median)", "lowest", "highest")
    for name, values in rates.items():
        table.add_row(name, f"{medians[name]:,.0f}", f"{min(values):,.0f}", f"{max(values):,.0f}")
    Console().print(table)
    Console().print(f"vector environment / bare physics: {np.median(shares):.0%}")
    result = {
        "bank": Path(arguments.bank).name,
        "num_envs": arguments.num_envs,
        "steps_per_second": {name: round(value) for name, value in medians.items()},
        "share_of_bare_physics": round(float(np.median(shares)), 3),
    }
    write_results(arguments.out, result, ["mujoco", "gymnasium"])


if __name__ == "__main__":
    main()
