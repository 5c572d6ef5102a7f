"""How many environment steps per second, side by side with the physics alone and with another package's environment.

python benchmarks/throughput.py --fetch-python /path/to/python

Everything acts at random, resets included, in turns, so that whatever else the machine does falls on all alike; the
figures are medians over the rounds, and ratios are taken within each round. The bare physics are `Batch.step` over the
same scenes with the same commands: no contacts read, nothing observed, no new episodes. ``--fetch-python`` names the
interpreter of an environment with gymnasium-robotics in it (benchmarks/fetch_reach.py says how to make one); without it
that comparison is left out.
"""

from __future__ import annotations

import argparse
import copy
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from results_file import RESULTS, write_results
from rich.console import Console
from rich.table import Table

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.envs import GreenhouseEnv, GreenhouseVectorEnv
from greenhouse_gym.envs.contacts import CONTACT_GROUPS, Contacts
from greenhouse_gym.envs.settings import PHYSICS
from greenhouse_gym.envs.state import ACTION_STEP, SUBSTEPS
from greenhouse_gym.geometry import Box
from greenhouse_gym.scene import Provenance, Scene, Target, compile_scene
from greenhouse_gym.scene.bank import write_bank

ROUNDS, STEPS, SINGLE_STEPS, FETCH_STEPS = 15, 30, 600, 25
OBSTACLES = (20, 100, 300, 1000)


def rate(steps: int, act: Callable[[], None]) -> float:
    """Steps per second of something that does so many."""
    began = time.perf_counter()
    act()
    return steps / (time.perf_counter() - began)


@contextmanager
def fetch_reach(python: str | None) -> Iterator[dict[str, Callable[[], float]]]:
    """Functions that measure FetchReach in a process that is kept warm; none without an interpreter for it."""
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


def bare_physics(vector: GreenhouseVectorEnv, actions: np.ndarray) -> Callable[[], None]:
    """Steps the scenes of a vector environment, compiled without what the environment adds, and does nothing else."""
    simulation = vector.simulation
    models, starts = [], []
    for i in range(vector.num_envs):
        episode = simulation.episode(i)
        compiled = compile_scene(episode.scene, simulation.robot, simulation.worlds.capacity)
        model = copy.copy(compiled.model)
        compiled.allow_cup_on(model, episode.targets[0])
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


def measure(arguments: argparse.Namespace) -> dict[str, list[float]]:
    """Rates of every round, by what was measured."""
    count = arguments.num_envs
    where = {"bank": arguments.bank, "split": arguments.split}
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, count, 6))
    vector = GreenhouseVectorEnv(count, **where, autoreset_mode="SameStep", threads=arguments.threads)
    depth = GreenhouseVectorEnv(64, **where, observation="depth", autoreset_mode="SameStep", threads=arguments.threads)
    single = GreenhouseEnv(**where)
    twins = {
        physics: GreenhouseVectorEnv(64, **where, physics=physics, autoreset_mode="SameStep", threads=arguments.threads)
        for physics in (PHYSICS if vector.simulation.sampler.bank.largest_truth() else ())
    }
    for env in (vector, depth, *twins.values()):
        env.reset(seed=0)
    for name in single.simulation.sampler.bank.names(arguments.split):  # compiles every scene, which is not measured
        single.reset(options={"scene": name, "target": 0})
    simulation = depth.simulation
    step_bare = bare_physics(vector, actions)

    def step_vector() -> None:
        for action in actions:
            vector.step(action)

    def step_single() -> None:
        for action in np.resize(actions[:, 0], (SINGLE_STEPS, 6)):
            *_, terminated, truncated, _ = single.step(action)
            if terminated or truncated:
                single.reset()

    def reset_single() -> None:
        for _ in range(SINGLE_STEPS):
            single.reset()

    def look() -> None:
        steps = np.zeros(64, dtype=int)
        contacts = Contacts(np.zeros((64, len(CONTACT_GROUPS)), dtype=int), np.zeros(64, dtype=bool), {})
        for _ in range(3):
            simulation._perception.look(slice(None), simulation._physics, contacts, steps, {})

    def step_depth() -> None:
        for action in actions[:5, :64]:
            depth.step(action)

    def step_twin(env: GreenhouseVectorEnv) -> float:
        env.reset(seed=0)
        return rate(64 * STEPS, lambda: [env.step(action) for action in actions[:, :64]] and None)

    rates: dict[str, list[float]] = {}
    with fetch_reach(arguments.fetch_python) as fetch:
        # What is compared comes one after the other.
        tasks: dict[str, Callable[[], float]] = {
            "bare Batch.step": lambda: rate(count * STEPS, step_bare),
            "vector environment": lambda: rate(count * STEPS, step_vector),
            **{name: task for name, task in fetch.items() if "Async" in name},
            "single environment": lambda: rate(SINGLE_STEPS, step_single),
            **{name: task for name, task in fetch.items() if "single" in name},
            "single environment, resets": lambda: rate(SINGLE_STEPS, reset_single),
            "depth images 64x48, 64 simulations": lambda: rate(64 * 3, look),
            "depth environment, 64 simulations": lambda: rate(64 * 5, step_depth),
            **{f"physics {physics}, 64 simulations": partial(step_twin, env) for physics, env in twins.items()},
        }
        for _ in range(ROUNDS):
            for name, task in tasks.items():
                if name == "vector environment":
                    vector.reset(seed=0)
                elif "single env" in name:
                    single.reset(seed=0)
                rates.setdefault(name, []).append(task())
    return rates


def obstacles_table(threads: int) -> dict[int, float]:
    """Median steps per second of 64 simulations by the number of obstacles in the scene."""
    banks, rates = {}, {count: [] for count in OBSTACLES}
    with tempfile.TemporaryDirectory() as folder:
        for count in OBSTACLES:
            scenes = [(crowded_scene(seed, count), "train") for seed in range(4)]
            banks[count] = write_bank(Path(folder) / str(count), scenes, name=f"{count} obstacles")
        envs = {
            count: GreenhouseVectorEnv(64, bank=bank, capacity=count, autoreset_mode="SameStep", threads=threads)
            for count, bank in banks.items()
        }
        for env in envs.values():
            env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, 64, 6))
    for _ in range(ROUNDS):
        for count, env in envs.items():
            env.reset(seed=0)
            rates[count].append(rate(64 * STEPS, lambda env=env: [env.step(action) for action in actions] and None))
    return {count: float(np.median(values)) for count, values in rates.items()}


def crowded_scene(seed: int, count: int) -> Scene:
    """Leaf-like boxes and tomatoes, as dense everywhere however many there are."""
    random = np.random.default_rng(seed)
    spread = [0.25, 0.2 + 0.0012 * count, 0.7]
    centers = [0.75, 0.0, 1.1] + random.uniform(-1, 1, (count, 3)) * spread
    tomatoes = [Tomato(center, 0.03, truss=0) for center in centers[: count // 10]]
    clutter = [Box(center, random.uniform(0.005, 0.04, 3), np.eye(3)) for center in centers[count // 10 :]]
    return Scene(
        name=f"crowded-{count}-{seed}",
        tomatoes=tuple(tomatoes),
        clutter=tuple(clutter),
        targets=tuple(Target(tomato=i, difficulty="easy") for i in range(len(tomatoes))),
        provenance=Provenance(row=f"crowded-{count}-{seed}"),
    )


def memory_of_the_vector_environment(arguments: argparse.Namespace) -> float:
    """Peak resident memory, GB, of a process that runs the environment on every scene of the split."""
    code = (
        "import resource, sys, numpy as np\n"
        "from greenhouse_gym.envs import GreenhouseVectorEnv\n"
        f"env = GreenhouseVectorEnv({arguments.num_envs}, bank={arguments.bank!r}, split={arguments.split!r},"
        " autoreset_mode='SameStep')\n"
        "env.reset(seed=0)\n"
        f"for name in env.simulation.sampler.bank.names({arguments.split!r}):\n"
        "    env.reset(options={'scene': name, 'target': 0})\n"
        "for _ in range(50):\n"
        "    env.step(env.action_space.sample())\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1]) * 1024 / 1e9


def ratios(rates: dict[str, list[float]]) -> dict[str, float]:
    """Medians of the ratios within each round."""
    pairs = {
        "vector environment / bare Batch.step": ("vector environment", "bare Batch.step"),
        "vector environment / FetchReach-v4 AsyncVectorEnv(8)": (
            "vector environment",
            "FetchReach-v4, AsyncVectorEnv(8)",
        ),
        "single environment / FetchReach-v4 single": ("single environment", "FetchReach-v4, single"),
        "physics truth / reconstruction": (
            "physics truth, 64 simulations",
            "physics reconstruction, 64 simulations",
        ),
    }
    return {
        name: float(np.median(np.array(rates[one]) / np.array(rates[other])))
        for name, (one, other) in pairs.items()
        if one in rates and other in rates
    }


def main() -> None:
    """Measure, print tables and write them down with versions and machine."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", default="default")
    parser.add_argument("--split", default="train")
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--fetch-python")
    parser.add_argument("--out", type=Path, default=RESULTS / "throughput.json")
    arguments = parser.parse_args()
    console = Console(width=120)
    rates = measure(arguments)
    table = Table("what", "per second (median)", "lowest", "highest")
    for name, values in rates.items():
        table.add_row(name, f"{np.median(values):,.0f}", f"{min(values):,.0f}", f"{max(values):,.0f}")
    console.print(table)
    compared = ratios(rates)
    for name, ratio in compared.items():
        console.print(f"{name}: {ratio:.2f}")
    reset = 1000 / float(np.median(rates["single environment, resets"]))
    console.print(f"reset with a new scene, single environment: {reset:.2f} ms")
    crowded = obstacles_table(arguments.threads)
    table = Table("obstacles per scene", "steps/s, 64 simulations")
    for count, value in crowded.items():
        table.add_row(str(count), f"{value:,.0f}")
    console.print(table)
    memory = memory_of_the_vector_environment(arguments)
    console.print(f"peak memory of {arguments.num_envs} simulations on the whole split: {memory:.2f} GB")
    result: dict[str, Any] = {
        "bank": Path(arguments.bank).name,
        "num_envs": arguments.num_envs,
        "per_second": {name: round(float(np.median(values))) for name, values in rates.items()},
        "ratios": {name: round(ratio, 3) for name, ratio in compared.items()},
        "reset_ms": round(reset, 3),
        "steps_per_second_by_obstacles": {str(count): round(value) for count, value in crowded.items()},
        "peak_memory_gb": round(memory, 2),
    }
    write_results(arguments.out, result, ["mujoco", "gymnasium"])


if __name__ == "__main__":
    main()
