"""Compare the speed of the Warp environment on one processor core with that of the MuJoCo environment.

python -m benchmarks.speed.warp

Both step the same number of simulations with random actions and autoreset, in turns, on one thread. Figures are medians
over the rounds of processor time per step, and the ratio is taken within each round. Takes 3 minutes.
"""

from __future__ import annotations

from pathlib import Path
from time import process_time
from typing import Any

import gymnasium
import numpy as np

import greenhouse_gym  # noqa: F401  registers the environments
from benchmarks.common import RESULTS, parser, seconds_of, table, write_results

ROUNDS, STEPS, WARM_UP = 9, 20, 60


def measure(bank: str, num_envs: int, precision: str) -> dict[str, list[float]]:
    """Return the processor time per step, microseconds, of every round by backend."""
    shared: dict[str, Any] = {"num_envs": num_envs, "bank": bank}
    envs = {
        "mujoco": gymnasium.make_vec("TomatoReach-v0", threads=1, **shared),
        "warp": gymnasium.make_vec("TomatoReach-v0", backend="warp", precision=precision, **shared),
    }
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (STEPS, num_envs, 6)).astype(np.float32)
    times: dict[str, list[float]] = {name: [] for name in envs}
    for env in envs.values():
        env.reset(seed=0)
        for k in range(WARM_UP):  # into the middle of episodes
            env.step(actions[k % STEPS])
    for _ in range(ROUNDS):
        for name, env in envs.items():
            seconds = seconds_of(lambda env=env: [env.step(action) for action in actions], process_time)  # type: ignore[misc]
            times[name].append(1e6 * seconds / STEPS / num_envs)
    return times


def main() -> None:
    """Measure, print a table, write the results."""
    command = parser(__doc__)
    command.add_argument("--bank", default="default")
    command.add_argument("--num-envs", type=int, default=256)
    command.add_argument("--out", type=Path, default=RESULTS / "warp.json")
    a = command.parse_args()
    results: dict[str, Any] = {"bank": a.bank, "num_envs": a.num_envs}
    rows = []
    for precision in ("float64", "float32"):
        times = measure(a.bank, a.num_envs, precision)
        figures = {f"{name}, us per step": round(float(np.median(own)), 2) for name, own in times.items()}
        figures["ratio"] = round(float(np.median(np.divide(times["mujoco"], times["warp"]))), 2)
        results[precision] = figures
        rows.append((precision, *figures.values()))
    print(table(("precision", "MuJoCo, us per step", "Warp, us per step", "ratio"), rows))
    write_results(a.out, results)


if __name__ == "__main__":
    main()
