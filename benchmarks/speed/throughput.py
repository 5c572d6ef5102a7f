"""Measure environment steps per second, next to the physics alone and another package's environment.

python -m benchmarks.speed.throughput --fetch-python /path/to/python

Actions are random, resets are included, and all candidates take turns, so that other work on the machine affects all
alike. Figures are medians over the rounds, and ratios are taken within each round. The bare physics are `Batch.step`
over the same scenes with the same commands: no contacts are read, nothing is observed, no episode begins.
``--fetch-python`` names the interpreter of an environment with gymnasium-robotics (see fetch_reach.py); without it that
comparison is left out. Takes 15 minutes.
"""

from __future__ import annotations

import argparse
import copy
import json
import resource
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from benchmarks.common import RESULTS, in_own_process, parser, seconds_of, table, write_results
from greenhouse_gym.envs import GreenhouseEnv, GreenhouseVectorEnv
from greenhouse_gym.envs.contacts import CONTACT_GROUPS, Contacts
from greenhouse_gym.envs.settings import PHYSICS
from greenhouse_gym.envs.state import ACTION_STEP, SUBSTEPS
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene import compile_scene

ROUNDS, STEPS, SINGLE_STEPS, FETCH_STEPS, SMALL = 15, 30, 600, 25, 64


@contextmanager
def fetch_reach(python: str | None) -> Iterator[dict[str, Callable[[], float]]]:
    """Yield functions that measure FetchReach in a process that stays warm; none without an interpreter."""
    if python is None:
        yield {}
        return
    command = [python, str(Path(__file__).with_name("fetch_reach.py"))]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    stdin, stdout = process.stdin, process.stdout

    def ask(kind: str, count: int) -> float:
        stdin.write(f"{kind} {count}\n")
        stdin.flush()
        return float(json.loads(stdout.readline()))

    try:
        yield {
            "FetchReach-v4, AsyncVectorEnv(8)": lambda: ask("async", FETCH_STEPS),
            "FetchReach-v4, single": lambda: ask("single", SINGLE_STEPS // 3),
        }
    finally:
        stdin.close()
        process.wait()


def bare_physics(vector: GreenhouseVectorEnv, actions: Array) -> Callable[[], None]:
    """Return a function that only steps the scenes of a vector environment, compiled without its additions."""
    simulation = vector.simulation
    models, starts = [], []
    for i in range(vector.num_envs):
        episode = simulation.episode(i)
        compiled = compile_scene(episode.scene, simulation.robot, simulation.worlds.capacity)
        model = copy.copy(compiled.model)
        for target in episode.targets:
            compiled.allow_cup_on(model, target)
        model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        models.append(model)
        starts.append(episode.start)
    batch = Batch(models[0], len(models), simulation._threads, persistent=True)
    batch.set_models(models)
    controls, joints = batch.bind("ctrl"), batch.bind("qpos")

    def step() -> None:
        batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        joints[:] = starts
        for action in actions:
            controls[:] = joints + ACTION_STEP * action
            batch.step(nstep=SUBSTEPS)

    return step


def measure(a: argparse.Namespace) -> dict[str, list[float]]:
    """Return the rates of every round by candidate."""
    where: dict[str, Any] = {"bank": a.bank, "split": a.split, "action": "joint"}
    batch: dict[str, Any] = {**where, "autoreset_mode": "SameStep", "threads": a.threads}
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, a.num_envs, 6))
    vector = GreenhouseVectorEnv(a.num_envs, **batch)
    depth = GreenhouseVectorEnv(SMALL, observation="depth", **batch)
    single = GreenhouseEnv(**where)
    bank = vector.simulation.sampler.bank
    twins = {
        physics: GreenhouseVectorEnv(SMALL, physics=physics, **batch)
        for physics in (PHYSICS if bank.largest_truth() else ())
    }
    for env in (vector, depth, *twins.values()):
        env.reset(seed=0)
    for name in bank.names(a.split):  # compiles every scene, which is not measured
        single.reset(options={"scene": name, "target": 0})
    step_bare = bare_physics(vector, actions)

    def step_all(env: GreenhouseVectorEnv, action: Array, seed: int | None = 0) -> float:
        if seed is not None:
            env.reset(seed=seed)
        return action.shape[0] * action.shape[1] / seconds_of(lambda: [env.step(action) for action in action])

    def step_single() -> None:
        for action in np.resize(actions[:, 0], (SINGLE_STEPS, 6)):
            *_, terminated, truncated, _ = single.step(action)
            if terminated or truncated:
                single.reset()

    def rate_single(act: Callable[[], object]) -> float:
        single.reset(seed=0)
        return SINGLE_STEPS / seconds_of(act)

    def take_images() -> None:
        steps = np.zeros(SMALL, dtype=int)
        counts = np.zeros((SMALL, len(CONTACT_GROUPS)), dtype=int)
        contacts = Contacts(counts, counts[:, 0], np.zeros(SMALL, dtype=bool), {})
        for _ in range(3):
            depth.simulation._perception.look(slice(None), depth.simulation._physics, contacts, steps, {})

    rates: dict[str, list[float]] = {}
    with fetch_reach(a.fetch_python) as fetch:
        # Candidates that are compared follow each other.
        tasks: dict[str, Callable[[], float]] = {
            "bare Batch.step": lambda: a.num_envs * STEPS / seconds_of(step_bare),
            "vector environment": partial(step_all, vector, actions),
            **{name: task for name, task in fetch.items() if "Async" in name},
            "single environment": partial(rate_single, step_single),
            **{name: task for name, task in fetch.items() if "single" in name},
            "single environment, resets": partial(rate_single, lambda: [single.reset() for _ in range(SINGLE_STEPS)]),
            "depth images 64x48, 64 simulations": lambda: SMALL * 3 / seconds_of(take_images),
            "depth environment, 64 simulations": partial(step_all, depth, actions[:5, :SMALL], None),
            **{
                f"physics {physics}, 64 simulations": partial(step_all, env, actions[:, :SMALL])
                for physics, env in twins.items()
            },
        }
        for _ in range(ROUNDS):
            for name, task in tasks.items():
                rates.setdefault(name, []).append(task())
    return rates


def peak_memory(num_envs: int, bank: str, split: str) -> float:
    """Return the peak memory, GB, of this process after the environment has run on every scene of the split."""
    env = GreenhouseVectorEnv(num_envs, bank=bank, split=split, autoreset_mode="SameStep")
    env.reset(seed=0)
    for name in env.simulation.sampler.bank.names(split):
        env.reset(options={"scene": name, "target": 0})
    for _ in range(50):
        env.step(env.action_space.sample())
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def ratios(rates: dict[str, list[float]]) -> dict[str, float]:
    """Return the medians of the ratios within each round."""
    fetch = "FetchReach-v4"
    pairs = {
        "vector environment / bare Batch.step": ("vector environment", "bare Batch.step"),
        f"vector environment / {fetch} AsyncVectorEnv(8)": ("vector environment", f"{fetch}, AsyncVectorEnv(8)"),
        f"single environment / {fetch} single": ("single environment", f"{fetch}, single"),
        "physics truth / reconstruction": [f"physics {physics}, 64 simulations" for physics in reversed(PHYSICS)],
    }
    return {
        name: round(float(np.median(np.divide(rates[one], rates[other]))), 3)
        for name, (one, other) in pairs.items()
        if one in rates and other in rates
    }


def main() -> None:
    """Measure, print tables, write the results."""
    command = parser(__doc__)
    command.add_argument("--bank", default="default")
    command.add_argument("--split", default="train")
    command.add_argument("--num-envs", type=int, default=256)
    command.add_argument("--threads", type=int, default=0)
    command.add_argument("--fetch-python")
    command.add_argument("--out", type=Path, default=RESULTS / "throughput.json")
    a = command.parse_args()
    rates = measure(a)
    medians = {name: float(np.median(values)) for name, values in rates.items()}
    lines = [(name, *(f"{x:,.0f}" for x in (medians[name], min(own), max(own)))) for name, own in rates.items()]
    print(table(("candidate", "per second (median)", "lowest", "highest"), lines))
    results: dict[str, Any] = {
        "bank": Path(a.bank).name,
        "num_envs": a.num_envs,
        "per_second": {name: round(value) for name, value in medians.items()},
        "ratios": ratios(rates),
        "reset_ms": round(1000 / medians["single environment, resets"], 3),
        "peak_memory_gb": round(in_own_process(peak_memory, a.num_envs, a.bank, a.split), 2),
    }
    for name in ("ratios", "reset_ms", "peak_memory_gb"):
        print(f"{name}: {results[name]}")
    write_results(a.out, results)


if __name__ == "__main__":
    main()
