"""Compare a bank of many scenes with one of few: opening, steps and resets while a policy acts, memory.

python -m benchmarks.speed.large_banks --scenes 20000 --few 36

Both banks consist of copies of the scenes of ``mini`` under other names, in a temporary folder. A vector environment on
each is stepped in turns with the actions of the shipped policy, so that other work on the machine affects both; seconds
are processor time of ``step``, resets included. The first reset, which finds nothing prepared, is reported separately.
A process of its own resets an environment on the large bank until ``--resets`` episodes have begun, and reports its
memory. Takes 15 minutes.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.common import RESULTS, in_own_process, parser, seconds_of, write_results
from greenhouse_gym import ENV_IDS
from greenhouse_gym.agents import PolicyAgent
from greenhouse_gym.envs import GreenhouseVectorEnv
from greenhouse_gym.envs.episodes import DRAWS_PER_SCENE, WINDOW
from greenhouse_gym.scene import SceneBank
from greenhouse_gym.scene.manifest import MANIFEST

SIMULATIONS, STEPS = 64, 50


def main() -> None:
    """Measure and write the results."""
    command = parser(__doc__)
    command.add_argument("--scenes", type=int, default=20_000)
    command.add_argument("--few", type=int, default=36)
    command.add_argument("--resets", type=int, default=100_000)
    command.add_argument("--rounds", type=int, default=20, help=f"of {STEPS} steps on each bank")
    command.add_argument("--out", type=Path, default=RESULTS / "large_banks.json")
    arguments = command.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        small = copies_of_mini(Path(temporary) / "few", arguments.few)
        many = copies_of_mini(Path(temporary) / "many", arguments.scenes)
        results = {
            "window": {"scenes": WINDOW, "draws_per_scene": DRAWS_PER_SCENE},
            "open_s": round(seconds_of(partial(SceneBank.open, many)), 3),
            "make_s": round(seconds_of(lambda: gym.make(ENV_IDS[0], bank=many).close()), 3),
            **compared(small, many, arguments.rounds),
            "memory_after_resets_mb": round(in_own_process(memory_after, many, arguments.resets) / 2**20),
        }
    write_results(arguments.out, results)
    for name, value in results.items():
        print(f"{name}: {value}")


def copies_of_mini(folder: Path, count: int) -> Path:
    """Write a bank of training scenes, each a copy of one of ``mini`` with its own name and row."""
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
        entries.append(replace(entry, name=name, file=f"{name}.json", sha256=checksum, row=row, split="train"))
    manifest = mini.manifest.model_copy(update={"name": folder.name, "scenes": tuple(entries)})
    (folder / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n")
    return folder


def compared(small: Path, many: Path, rounds: int) -> dict[str, Any]:
    """Step environments on both banks in turns."""
    envs = {
        # with different capacities, so that neither takes the prepared worlds of the other
        name: GreenhouseVectorEnv(SIMULATIONS, bank=bank, autoreset_mode="SameStep", threads=1, capacity=600 + k)
        for k, (name, bank) in enumerate({"few": small, "many": many}.items())
    }
    policy = PolicyAgent.load("ppo-ur5e")
    first: dict[str, float] = {}
    observations: dict[str, Any] = {}
    for name, env in envs.items():
        first[name] = round(seconds_of(partial(env.reset, seed=0), time.process_time), 2)
        for _ in range(8):  # so that all of the few are prepared
            observations[name], _ = env.reset()
    seconds: dict[str, list[float]] = {name: [] for name in envs}
    ended = dict.fromkeys(envs, 0)
    for turn in range(rounds):
        for name in sorted(envs, reverse=bool(turn % 2)):
            spent = 0.0
            for _ in range(STEPS):
                actions = policy.act_many(observations[name])
                began = time.process_time()
                observations[name], _, terminated, truncated, _ = envs[name].step(actions)
                spent += time.process_time() - began
                ended[name] += int(np.count_nonzero(terminated | truncated))
            seconds[name].append(spent)
    return {
        "first_reset_cpu_s": first,
        "steps_per_cpu_s": {name: round(SIMULATIONS * STEPS / median(own)) for name, own in seconds.items()},
        "episodes": ended,
        "slower_median_of_rounds": round(median(np.divide(seconds["many"], seconds["few"])), 3),
        "slower_in_total": round(sum(seconds["many"]) / sum(seconds["few"]), 3),
    }


def memory_after(bank: Path, resets: int) -> int:
    """Return the memory of this process, bytes (Linux), after so many episodes have begun."""
    env = GreenhouseVectorEnv(SIMULATIONS, bank=bank, threads=1)
    for _ in range(resets // SIMULATIONS):
        env.reset()
        env.step(np.zeros((SIMULATIONS, 6)))
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    main()
