"""Measure policies alone and behind the shield: own easy, medium and all targets, and easy ones of Helios rows.

python -m benchmarks.agents.cells
python -m benchmarks.agents.cells runs/lesson_lengths/*.json

Without arguments, measures all shipped policies. 500 episodes of the test rows a cell, as scanned, from the start
`ready`; seeds from 20,000, so that all policies play the same episodes. A finished cell is not measured again. Takes
one minute for a policy alone and four behind the shield.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from benchmarks.agents.policies import outcomes
from benchmarks.common import RESULTS, parser, read_entry, write_entry
from greenhouse_gym.agents import PolicyAgent, ShieldedAgent
from greenhouse_gym.agents.agent import Agent
from greenhouse_gym.agents.policy_agent import shipped_policies
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.scene import DIFFICULTIES, SceneBank

CELLS = {
    "own, easy": ("own", "easy"),
    "own, medium": ("own", "medium"),
    "own, all": ("own", DIFFICULTIES),
    "helios, easy": ("helios", "easy"),
}
"""Sources and difficulties of the targets."""

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
    rows = bank.select(split="test", source=source)
    return outcomes(
        evaluate(agent, "test", episodes, 20_000, bank=rows, difficulty=difficulty, num_envs=64, threads=1).records
    )


if __name__ == "__main__":
    main()
