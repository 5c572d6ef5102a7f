"""What a bank of many scenes costs beside one of few: opening, resets while a policy acts, memory.

python benchmarks/large_banks.py --scenes 20000 --few 36

Both banks are made of copies of the scenes of ``mini`` under other names, in a temporary folder. A vector environment
on each is stepped in turns with the actions of the shipped policy, so that whatever else the machine does falls on
both; seconds are of processor time, in ``step`` alone, resets included. The first episodes, which find nothing ready,
are told apart. Beside it a process of its own resets an environment on the large bank until ``--resets`` episodes have
begun, and tells its memory.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium as gym
import numpy as np
from results_file import RESULTS, write_results

import greenhouse_gym
from greenhouse_gym.agents import PolicyAgent
from greenhouse_gym.common.executors import processes
from greenhouse_gym.envs import GreenhouseVectorEnv
from greenhouse_gym.envs.episodes import DRAWS_PER_SCENE, WINDOW
from greenhouse_gym.scene import SceneBank
from greenhouse_gym.scene.manifest import MANIFEST

SIMULATIONS, STEPS = 64, 50


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20_000)
    parser.add_argument("--few", type=int, default=36)
    parser.add_argument("--resets", type=int, default=100_000)
    parser.add_argument("--rounds", type=int, default=20, help=f"of {STEPS} steps on each bank")
    parser.add_argument("--out", type=Path, default=RESULTS / "large_banks.json")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        few = copies_of_mini(Path(temporary) / "few", arguments.few)
        many = copies_of_mini(Path(temporary) / "many", arguments.scenes)
        result = measure(few, many, arguments.resets, arguments.rounds)
    command = f"benchmarks/large_banks.py --scenes {arguments.scenes} --few {arguments.few} "
    command += f"--resets {arguments.resets} --rounds {arguments.rounds}"
    write_results(arguments.out, {"command": command, **result}, ["mujoco"])
    for name, value in result.items():
        print(f"{name}: {value}")


def copies_of_mini(folder: Path, count: int) -> Path:
    """A bank of so many training scenes, each a copy of one of ``mini`` with a name and a row of its own."""
    folder.mkdir()
    mini = SceneBank.open("mini")
    texts = [(entry, (mini.path / entry.file).read_text()) for entry in mini.manifest.scenes]
    entries = []
    for k in range(count):
        entry, text = texts[k % len(texts)]
        name, row = f"copy-{k:06d}-00", f"copy-{k:06d}"
        content = text.replace(f'"name":"{entry.name}"', f'"name":"{name}"', 1)
        content = content.replace(f'"row":"{entry.row}"', f'"row":"{row}"', 1)
        (folder / f"{name}.json").write_text(content)
        checksum = hashlib.sha256(content.encode()).hexdigest()
        changes = {"name": name, "file": f"{name}.json", "sha256": checksum, "row": row, "split": "train"}
        entries.append(replace(entry, **changes))
    manifest = mini.manifest.model_copy(update={"name": folder.name, "scenes": tuple(entries)})
    (folder / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n")
    return folder


def measure(few: Path, many: Path, resets: int, rounds: int) -> dict[str, Any]:
    """All figures."""
    opening = seconds(lambda: SceneBank.open(many))
    making = seconds(lambda: gym.make(greenhouse_gym.ENV_IDS[0], bank=many).close())
    banks = {"few": few, "many": many}
    envs = {
        # other capacities, so that neither takes the room of the other's worlds, which environments of a kind share
        name: GreenhouseVectorEnv(SIMULATIONS, bank=bank, autoreset_mode="SameStep", threads=1, capacity=300 + k)
        for k, (name, bank) in enumerate(banks.items())
    }
    policy = PolicyAgent.load("ppo-ur5e")
    observations = {}
    first = {}
    for name, env in envs.items():
        began = time.process_time()
        observations[name], _ = env.reset(seed=0)
        first[name] = round(time.process_time() - began, 2)
        for _ in range(8):  # so that all of the few are ready
            env.reset()
    rates: dict[str, list[float]] = {name: [] for name in envs}
    ended = dict.fromkeys(envs, 0)
    for turn in range(rounds):
        for name in sorted(envs, reverse=bool(turn % 2)):
            env, spent = envs[name], 0.0
            for _ in range(STEPS):
                actions = policy.act_many(observations[name])
                began = time.process_time()
                observations[name], _, terminated, truncated, _ = env.step(actions)
                spent += time.process_time() - began
                ended[name] += int(np.count_nonzero(terminated | truncated))
            rates[name].append(SIMULATIONS * STEPS / spent)
    ratios = [one / other for one, other in zip(rates["few"], rates["many"], strict=True)]
    total = {name: sum(SIMULATIONS * STEPS / rate for rate in values) for name, values in rates.items()}
    with processes(1) as executor:
        memory = executor.submit(memory_after, many, resets).result()
    return {
        "window": {"scenes": WINDOW, "draws_per_scene": DRAWS_PER_SCENE},
        "open_s": round(opening, 3),
        "make_s": round(making, 3),
        "first_reset_cpu_s": first,
        "steps_per_cpu_s": {name: round(median(values)) for name, values in rates.items()},
        "episodes": ended,
        "slower_median_of_rounds": round(median(ratios), 3),
        "slower_in_total": round(total["many"] / total["few"], 3),
        "memory_after_resets_mb": round(memory / 2**20),
    }


def seconds(act: Callable[[], object]) -> float:
    """How long something takes."""
    began = time.perf_counter()
    act()
    return time.perf_counter() - began


def memory_after(bank: Path, resets: int) -> int:
    """Bytes of this process in memory (Linux) after so many episodes have begun."""
    env = GreenhouseVectorEnv(SIMULATIONS, bank=bank, threads=1)
    for _ in range(resets // SIMULATIONS):
        env.reset()
        env.step(np.zeros((SIMULATIONS, 6)))
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    main()
