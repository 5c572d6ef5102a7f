"""Stable-Baselines3 with its simulations in two Ray actors, against all of them in the same process.

python benchmarks/sb3_actors.py --steps 16384
python benchmarks/sb3_actors.py --steps 16384 --rounds 3 --pinned --out sb3_actors_pinned.json

PPO of the usual settings but for the number of steps, in turns here and with actors. Steps per second of processor time
count this process, while it learns and steps or waits, and the actors. Before that the same
actions are played in both, and observations, rewards and ends of episodes compared bit for bit.

Two threads of one core slow each other down, and only the actors run on both at once. Pinned, all processes share one
of them. What is then left of the difference is the cost of sending things to actors and back, and that of a step of few
simulations, which costs more for each of them than a step of many.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from greenhouse_gym.learning.sb3_ray import make_sb3_ray_vec_env
from results_file import RESULTS, write_results

from greenhouse_gym.learning import PpoSettings, train_ppo
from greenhouse_gym.learning.sb3 import make_sb3_vec_env

ACTORS = 2
WARM = 100  # steps of all simulations, in which many episodes end and the scenes of the bank are met
BANK = "mini"  # whose scenes are soon ready, so that steps are measured and not the making of worlds


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=16_384, help="of a training")
    parser.add_argument("--num-envs", type=int, default=128, help="simulations, of both actors together")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--compared", type=int, default=100, help="steps of all simulations that are compared")
    parser.add_argument("--pinned", action="store_true", help="have all processes share one processor")
    parser.add_argument("--out", default="sb3_actors.json", help="file among the results")
    a = parser.parse_args()
    if a.pinned:
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # before Ray starts: its processes inherit it
    makers: dict[str, Any] = {"here": make_sb3_vec_env, "actors": partial(make_sb3_ray_vec_env, actors=ACTORS)}
    ended = compare(makers, a.num_envs, a.compared)
    rates: dict[str, list[float]] = {way: [] for way in makers}
    settings = PpoSettings(
        bank=BANK, observation="state", reward="dense", total_steps=a.steps, num_envs=a.num_envs, threads=1
    )
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(a.rounds):
            for way in sorted(makers, reverse=bool(turn % 2)):
                watch = Watch(makers[way])
                train_ppo(settings, Path(folder) / f"{way}-{turn}", make_env=watch.make)
                rates[way].append(round(a.steps / watch.seconds))
                print(way, rates[way][-1], flush=True)
    result = {
        "command": (
            f"benchmarks/sb3_actors.py --steps {a.steps} --rounds {a.rounds} --compared {a.compared}"
            f" --num-envs {a.num_envs}{' --pinned' * a.pinned} --out {a.out}"
        ),
        "steps compared bit for bit": a.compared * a.num_envs,
        "episodes that ended in them": ended,
        "steps per processor second": rates,
        "actors against here": round(median(rates["actors"]) / median(rates["here"]), 3),
        "load at the end": round(os.getloadavg()[0], 1),
    }
    print(result)
    write_results(RESULTS / a.out, result, ["ray", "mujoco", "torch", "stable-baselines3"])


class Watch:
    """Notes the processor time from when the environment that it makes is warm to its end, of all processes."""

    def __init__(self, make: Any):
        self._make = make
        self.seconds = 0.0

    def make(self, *arguments: Any, **options: Any) -> Any:
        """The environment."""
        env = self._make(*arguments, **options)
        env.reset()
        for _ in range(WARM):  # what each process makes, reads and compiles once for a scene is not counted
            env.step(np.ones((env.num_envs, *env.action_space.shape), dtype=np.float32))
        began, close = seconds_of_all(), env.close

        def end() -> None:
            self.seconds = seconds_of_all() - began
            close()

        env.close = end
        return env


def seconds_of_all() -> float:
    """Processor time of this process and of the actors so far (Linux)."""
    return time.process_time() + sum(map(_seconds_of, Path("/proc").glob("[1-9]*")))


def _seconds_of(process: Path) -> float:
    """Of an actor that keeps simulations; of any other process nothing."""
    try:
        if not (process / "cmdline").read_bytes().startswith(b"ray::_Keeper"):
            return 0.0
        fields = (process / "stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def compare(makers: dict[str, Any], count: int, steps: int) -> int:
    """Play the same actions in all; how many episodes ended.

    Raises:
        AssertionError: Something differs.
    """
    here, actors = (make(count, bank=BANK, seed=0) for make in makers.values())
    np.testing.assert_array_equal(here.reset(), actors.reset())
    random, ended = np.random.default_rng(0), 0
    lean = random.uniform(-1, 1, (count, 6))
    for _ in range(steps):
        actions = np.clip(lean + random.normal(0, 0.3, lean.shape), -1, 1).astype(np.float32)
        of_here, of_actors = here.step(actions), actors.step(actions)
        for one, other in zip(of_here[:3], of_actors[:3], strict=True):
            np.testing.assert_array_equal(one, other)
        ended += int(of_here[2].sum())
    here.close()
    actors.close()
    return ended


if __name__ == "__main__":
    main()
