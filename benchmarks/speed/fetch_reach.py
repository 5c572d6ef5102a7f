"""Steps per second of Gymnasium-Robotics' FetchReach-v4, alone and in 8 processes; prints JSON.

Runs by the interpreter of an environment of its own, since it needs an older MuJoCo: python -m venv fetch;
fetch/bin/pip install gymnasium-robotics "mujoco<3.4"; fetch/bin/python benchmarks/fetch_reach.py
"""

import json
import sys
import time

import gymnasium
import gymnasium_robotics
import numpy as np

gymnasium.register_envs(gymnasium_robotics)
ID, WORKERS = "FetchReach-v4", 8


def main() -> None:
    """Answer every line on standard input ("single 200", "async 50") with a rate."""
    single, many = gymnasium.make(ID), gymnasium.make_vec(ID, WORKERS, vectorization_mode="async")
    single.reset(seed=0)
    many.reset(seed=0)
    rng = np.random.default_rng(0)
    for line in sys.stdin:
        kind, count = line.split()[0], int(line.split()[1])
        actions = rng.uniform(-1, 1, (count, WORKERS, 4)).astype(np.float32)
        began = time.perf_counter()
        for action in actions:
            if kind == "async":
                many.step(action)
            else:
                *_, terminated, truncated, _ = single.step(action[0])
                if terminated or truncated:
                    single.reset()
        rate = count * (WORKERS if kind == "async" else 1) / (time.perf_counter() - began)
        print(json.dumps(rate), flush=True)
    many.close()


if __name__ == "__main__":
    main()
