"""How often the agent that sees with its wrist's camera reaches tomatoes of unseen rows, and what its parts are worth.

python benchmarks/depth_policy.py --judge runs/depth/judge.json --blind runs/blind/judge.json

On the same episodes of the validation rows, easy and medium targets, play: the agent by its trained network
(``learned``), by the rule in which nothing is learned (``rule``), by a network that was trained and plays without
images (``blind``), the agent ``exploring``, which plans, and the agent ``waypoint``, which knows the scene. The world
is the reconstruction, or with ``--physics truth`` the simulated row behind it, which is then what the camera sees.
Writes results/depth_policy.json as it goes; entries of others that it holds stay.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from policies import rates
from results_file import RESULTS, write_results

from greenhouse_gym.agents.agent import Agent
from greenhouse_gym.agents.depth_agent import DepthAgent
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.evaluation import Evaluation, evaluate
from greenhouse_gym.evaluation.records import Record
from greenhouse_gym.scene import SceneBank

FIRST_SEED = 20_000
"""Of the episodes."""

DIFFICULTY = ("easy", "medium")

USUAL = ("validation", f"seeds from {FIRST_SEED} on", "reconstruction")
"""Split, seeds and world that the names of entries do not tell."""

PART = 25
"""Episodes after which the figures so far are written."""


def main() -> None:
    """Play, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--judge", type=Path, help="a network of training/depth_dagger.py; without it that agent is left out"
    )
    parser.add_argument("--blind", type=Path, help="one that was trained with images=false; the same")
    parser.add_argument("--agents", default="learned,rule,blind,exploring,waypoint")
    parser.add_argument("--split", default="validation")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the first episode")
    parser.add_argument("--bank", default="default")
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--physics", default="reconstruction")
    parser.add_argument("--out", type=Path, default=RESULTS / "depth_policy.json")
    arguments = parser.parse_args()
    bank = SceneBank.open(arguments.bank)
    for name in arguments.agents.split(","):
        agent, training = _agent(name, arguments)
        if agent is None:
            continue
        about: dict[str, Any] = {
            "bank_sha256": bank.sha256,
            "split": arguments.split,
            "first_seed": arguments.seed,
            "difficulty": DIFFICULTY,
            "physics": arguments.physics,
        }
        played_in = (arguments.split, f"seeds from {arguments.seed} on", arguments.physics)
        name = ", ".join([name, *(part for part in played_in if part not in USUAL)])
        records: tuple[Record, ...] = ()
        for done in range(0, arguments.episodes, PART):
            played = evaluate(
                agent, arguments.split, min(PART, arguments.episodes - done), arguments.seed + done,
                bank=arguments.bank, difficulty=DIFFICULTY, physics=arguments.physics, threads=1,
            )  # fmt: skip
            records += played.records
            entry = {**about, **rates(Evaluation(name, records), bank), "training": training}
            agents = json.loads(arguments.out.read_text())["agents"] if arguments.out.is_file() else {}
            write_results(arguments.out, {"agents": {**agents, name: entry}}, ("torch", "mujoco"))
            print(name, len(records), entry["success"], entry["collision"], flush=True)


def _agent(name: str, arguments: argparse.Namespace) -> tuple[Agent | None, Any]:
    """Who plays, None where the network was not given, and how that came about."""
    if name not in ("learned", "blind"):
        return make_agent("depth" if name == "rule" else name), None
    path = arguments.judge if name == "learned" else arguments.blind
    if path is None:
        return None, None
    network = Policy.load(path)
    return DepthAgent.of(network, name), dict(network.training)


if __name__ == "__main__":
    main()
