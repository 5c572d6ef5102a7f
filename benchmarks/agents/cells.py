"""Measure policies alone and behind the shield: own easy, medium and all targets, and easy ones of Helios rows.

python -m benchmarks.agents.cells
python -m benchmarks.agents.cells runs/lesson_lengths/*.json --kinds alone

Without arguments, measures all shipped policies. The test rows as scanned, 500 episodes a cell with seeds from 20,000,
from the start `ready`. Alone, policies on the observation `state` play these episodes on the Warp kernels. A finished
cell is not measured again. Takes seconds for a policy on the kernels, and four minutes for one behind the shield.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.agents.policies import outcomes, rates_of
from benchmarks.common import RESULTS, parser, read_entry, write_entry
from greenhouse_gym.agents import PolicyAgent, ShieldedAgent
from greenhouse_gym.agents.agent import Agent
from greenhouse_gym.agents.policy_agent import shipped_policies
from greenhouse_gym.envs import make_vec
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.scene import DIFFICULTIES, SceneBank

CELLS = {
    "own, easy": ("own", "easy"),
    "own, medium": ("own", "medium"),
    "own, all": ("own", DIFFICULTIES),
    "helios, easy": ("helios", "easy"),
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
    command.add_argument("--episodes", type=int, default=500)
    a = command.parse_args()
    bank = SceneBank.open("default")
    for kind in a.kinds:
        for given in a.policies:
            policy = PolicyAgent.load(given)
            about = {"episodes": a.episodes, "bank_sha256": bank.sha256, "policy_sha256": checksum(given)}
            for cell in a.cells:
                figures = about | read_entry(RESULT, policy.name, about)
                key = f"{kind}, {cell}"
                if key not in figures:
                    figures[key] = played(policy if kind == "alone" else ShieldedAgent(policy), bank, cell, a.episodes)
                    print(policy.name, key, figures[key], flush=True)
                    write_entry(RESULT, policy.name, figures)


def checksum(policy: str) -> str:
    """Return the checksum of a policy's weights."""
    path = Path(shipped_policies().get(policy, policy))
    return hashlib.sha256(path.with_suffix(".safetensors").read_bytes()).hexdigest()


def played(agent: Agent, bank: SceneBank, cell: str, episodes: int) -> dict[str, Any]:
    """Return the outcomes of an agent in a cell."""
    source, difficulty = CELLS[cell]
    where = {"bank": bank.select(split="test", source=source), "split": "test", "difficulty": difficulty}
    if isinstance(agent, PolicyAgent) and agent.env_options["observation"] == "state":
        return on_kernels(agent, episodes, **where)
    return outcomes(evaluate(agent, episodes=episodes, seed=SEED, num_envs=16, threads=1, **where).records)


def on_kernels(agent: PolicyAgent, episodes: int, **where: Any) -> dict[str, Any]:
    """Return the outcomes of one episode in each of as many simulations."""
    env = make_vec(episodes, backend="warp", **where, **agent.env_options)
    drawn = [env.unwrapped.simulation.sampler.draw(np.random.default_rng(SEED + i)) for i in range(episodes)]
    observation, _ = env.reset(options=[{"scene": each.scene, "target": each.targets[0]} for each in drawn])
    running = np.ones(episodes, dtype=np.bool_)
    success, collision = np.zeros_like(running), np.zeros_like(running)
    while running.any():
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        ended = running & (terminated | truncated)
        success |= ended & info["is_success"]
        collision |= ended & info["collision"]
        running &= ~ended
    env.close()
    return rates_of(episodes, int(success.sum()), int(collision.sum()))


if __name__ == "__main__":
    main()
