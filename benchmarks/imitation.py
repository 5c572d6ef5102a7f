"""What imitation and PPO make of the observation ``waypoint``: success and collisions on validation rows, by seed.

python benchmarks/imitation.py --seeds 0,1,2 --out-folder runs/imitation
python benchmarks/imitation.py --agents "" --set from_rule=false --set imitation.steps=64000 --set ppo.total_steps=0

Trains once for each seed with the usual settings of ``training/bc_then_ppo.py``. Judged are, on the same episodes, the
policy after the imitation, if there is one, and after PPO, and the rule that it imitates (``waypoint``). With
``from_rule=false`` its weights are random at first.
Writes results/imitation.json, or with ``from_rule=false`` results/imitation_from_nothing.json, after each part; entries
of other seeds and agents that it holds stay, if they are of the same settings and bank.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from policies import rates
from results_file import RESULTS, kept_results, write_results

from greenhouse_gym.agents import PolicyAgent
from greenhouse_gym.agents.agent import Agent
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.common.settings_files import resolve
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.learning import BcThenPpoSettings, train_bc_then_ppo
from greenhouse_gym.scene import SceneBank

FIRST_SEED = 20_000
"""Of the episodes."""


def main() -> None:
    """Train, play, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--agents", default="waypoint")
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--out-folder", type=Path, default=Path("runs/imitation"))
    parser.add_argument("--out", type=Path, help="by default the file of results that the lines above name")
    arguments = parser.parse_args()
    settings = resolve(BcThenPpoSettings(), None, arguments.set)
    out = arguments.out or RESULTS / f"imitation{'' if settings.from_rule else '_from_nothing'}.json"
    about: dict[str, Any] = {
        "settings": asdict(settings), "bank_sha256": SceneBank.open(settings.ppo.bank).sha256, "split": "validation",
        "first_seed": FIRST_SEED,
    }  # fmt: skip
    figures = about | kept_results(out, about, ["agents", "policies"])

    def judged(agent: Agent) -> dict[str, Any]:
        options = {"bank": settings.ppo.bank, "num_envs": 64, "threads": 1}
        played = evaluate(agent, "validation", arguments.episodes, FIRST_SEED, **options)
        return rates(played, SceneBank.open(settings.ppo.bank))

    def note(part: str, name: str, entry: dict[str, Any]) -> None:
        figures[part][name] = entry
        print(name, json.dumps(entry), flush=True)
        write_results(out, figures, ("stable-baselines3", "torch", "mujoco"))

    for seed in filter(None, arguments.seeds.split(",")):
        minutes = elapsed = 0.0
        stages = {"imitation": 0, "imitation and PPO": settings.ppo.total_steps}
        if not settings.imitation.steps:
            stages = {"PPO from the rule": settings.ppo.total_steps}
        elif not settings.ppo.total_steps:
            stages = {"imitation": 0}
        for stage, total_steps in stages.items():
            ppo = replace(settings.ppo, seed=int(seed), total_steps=total_steps)
            began, looked = time.process_time(), time.monotonic()
            path = train_bc_then_ppo(
                replace(settings, ppo=ppo), arguments.out_folder / f"seed-{seed}", resume=stage == "imitation and PPO",
                tell=lambda steps, told: print(steps, {name: round(told[name], 3) for name in told}, flush=True),
            )  # fmt: skip
            minutes += (time.process_time() - began) / 60
            elapsed += (time.monotonic() - looked) / 60
            steps = {"labeled_steps": settings.imitation.steps, "ppo_steps": total_steps}
            times = {"processor_minutes": round(minutes, 2), "minutes": round(elapsed, 2)}
            entry = {**steps, **times, **judged(PolicyAgent.load(path))}
            note("policies", f"{stage}, seed {seed}", entry)
    for name in filter(None, arguments.agents.split(",")):
        note("agents", name, judged(make_agent(name)))


if __name__ == "__main__":
    main()
