"""Measure policies alone and behind the shield: own easy, medium and all targets, and easy ones of Helios rows.

python -m benchmarks.agents.cells
python -m benchmarks.agents.cells runs/lesson_lengths/*.json --kinds alone
python -m benchmarks.agents.cells runs/*.json --kinds alone --split validation --cells "helios, easy" "helios, medium"

Without arguments, measures all shipped policies. Rows as scanned, 500 episodes a cell with seeds from 20,000, from the
start `ready`. Policies are chosen on validation rows (`--split validation`); `--split train` is what a policy reaches
on the rows it was trained on. Alone, policies on the observation `state` play these episodes on the Warp kernels. A
finished cell is not measured again. Takes seconds for a policy on the kernels, and four minutes for one behind the
shield.
"""

from __future__ import annotations

import hashlib
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.agents.policies import outcomes, rates_of
from benchmarks.common import RESULTS, parser, read_entry, write_entry
from greenhouse_gym.agents import PolicyAgent, ShieldedAgent, load_policy
from greenhouse_gym.agents.agent import Agent
from greenhouse_gym.agents.policy_agent import shipped_policies
from greenhouse_gym.envs import EnvSettings, make_vec
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.scene import SceneBank

CELLS = {
    "own, easy": ("own", "easy"),
    "own, medium": ("own", "medium"),
    "own, all": ("own", EnvSettings().difficulty),
    "helios, easy": ("helios", "easy"),
    "helios, medium": ("helios", "medium"),
    "helios, all": ("helios", EnvSettings().difficulty),
}
"""Sources and difficulties of the targets."""

SEED = 20_000
"""Seed of the first episode."""

RESULT = RESULTS / "cells.json"


def main() -> None:
    """Play, and write the figures of each cell."""
    command = parser(__doc__)
    command.add_argument("policies", nargs="*", default=[*shipped_policies()], help="names, or policies' JSON files")
    command.add_argument("--kinds", nargs="+", default=["alone", "shielded"], choices=["alone", "shielded"])
    command.add_argument("--cells", nargs="+", default=[*CELLS], choices=[*CELLS])
    command.add_argument("--split", default="test", choices=["train", "validation", "test"])
    command.add_argument("--episodes", type=int, default=500)
    a = command.parse_args()
    bank = SceneBank.open("default")
    for kind, cell, given in product(a.kinds, a.cells, a.policies):
        policy, key = load_policy(given), ", ".join([a.split] * (a.split != "test") + [kind, cell])
        about = {"episodes": a.episodes, "bank_sha256": bank.sha256, "policy_sha256": checksum(given)}
        figures = about | read_entry(RESULT, policy.name, about)
        if key not in figures:
            figures[key] = outcomes_in(policy if kind == "alone" else ShieldedAgent(policy), cell, a.episodes, a.split)
            print(policy.name, key, figures[key], flush=True)
            write_entry(RESULT, policy.name, figures)


def checksum(policy: str) -> str:
    """Return the checksum of a policy's weights."""
    path = Path(shipped_policies().get(policy, policy))
    return hashlib.sha256(path.with_suffix(".safetensors").read_bytes()).hexdigest()


def outcomes_in(
    agent: Agent, cell: str, episodes: int, split: str = "test", rows: tuple[str, ...] | None = None
) -> dict[str, Any]:
    """Return the outcomes of an agent in a cell, on all rows of the split or on some."""
    if isinstance(agent, PolicyAgent) and agent.env_options["observation"] == "state":
        return on_kernels(agent, cell, episodes, split, rows)
    options = {"num_envs": 16, "threads": 1, **where(cell, split, rows)}
    return outcomes(evaluate(agent, split, episodes, SEED, **options).records)


def where(cell: str, split: str, rows: tuple[str, ...] | None) -> dict[str, Any]:
    """Return the keywords of a cell's environment."""
    source, difficulty = CELLS[cell]
    return {"bank": SceneBank.open("default").select(split=split, source=source, row=rows), "difficulty": difficulty}


def left_out_rows() -> list[str]:
    """Return own rows of the training split for choices that must not be made on test rows, left out of trainings."""
    own = SceneBank.open("default").select(split="train", source="own")
    return sorted({entry.row for entry in own.manifest.scenes})[::5]


@cache
def kernels(cell: str, episodes: int, split: str, rows: tuple[str, ...] | None, **options: str) -> Any:
    """Return the environment of a cell on the kernels, and the options of a reset to the episodes of `evaluate`."""
    env: Any = make_vec(episodes, backend="warp", split=split, **where(cell, split, rows), **options).unwrapped
    drawn = [env.simulation.sampler.draw(np.random.default_rng(SEED + i)) for i in range(episodes)]
    return env, [{"scene": each.scene, "target": each.targets[0]} for each in drawn]


def on_kernels(
    agent: PolicyAgent, cell: str, episodes: int, split: str, rows: tuple[str, ...] | None
) -> dict[str, Any]:
    """Return the outcomes of one episode in each of as many simulations."""
    env, chosen = kernels(cell, episodes, split, rows, **agent.env_options)
    observation, _ = env.reset(options=chosen)
    running = np.ones(episodes, dtype=np.bool_)
    success, collision = np.zeros_like(running), np.zeros_like(running)
    while running.any():
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        ended = running & (terminated | truncated)
        success |= ended & info["is_success"]
        collision |= ended & info["collision"]
        running &= ~ended
    return rates_of(episodes, int(success.sum()), int(collision.sum()))


if __name__ == "__main__":
    main()
