"""How SAC with hindsight replay learns on the goal environment, against random actions.

python benchmarks/sac_her.py
python benchmarks/sac_her.py --guided --seeds 0,1,2 --steps 60000 --test 1000 --out sac_her_guided.json

Trains with the default settings for some minutes, or so many steps, and writes the curve of each training seed to
results/sac_her.json. What counts are episodes of the validation split, whose rows were not trained on, judged without
the policy's noise. With ``--guided`` the bank is ``default``, the targets are easy and medium, the reward is sparse,
the waypoint is observed, the memory begins with demonstrations by the rule that follows it, and the actor is held near
that. With ``--test`` what was learned plays so many test episodes at the end, and so does the rule.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from results_file import RESULTS, write_results

from greenhouse_gym.agents import Agent, RandomAgent
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.evaluation import Evaluation, evaluate, wilson_interval
from greenhouse_gym.learning.sac import SacSettings, env_options, load_sac, train_sac
from greenhouse_gym.learning.sb3 import Sb3Agent
from greenhouse_gym.learning.training_run import Validation

GUIDED: dict[str, Any] = {
    "bank": "default",
    "difficulty": ("easy", "medium"),
    "observation": "goal_waypoint",
    "reward": "sparse",
    "guided": True,
    "random_steps": 30_000,
}
"""Settings with demonstrations, as they were tried."""


def main() -> None:
    """Train, play at random, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=16.0)
    parser.add_argument("--steps", type=int, help="end after so many steps instead, however long that takes")
    parser.add_argument("--every", type=int, default=20_000)
    parser.add_argument("--episodes", type=int, default=256)
    parser.add_argument("--seeds", default="0", help="training seeds, separated by commas")
    parser.add_argument("--guided", action="store_true")
    parser.add_argument("--test", type=int, default=0, help="test episodes, seeds from 0 on, played at the end")
    parser.add_argument("--out", type=Path, default=RESULTS / "sac_her.json")
    arguments = parser.parse_args()
    whole = SacSettings(
        threads=1, total_steps=arguments.steps or 10_000_000, validation_steps=arguments.every,
        validation_episodes=arguments.episodes, **(GUIDED if arguments.guided else {}),
    )  # fmt: skip
    figures: dict[str, Any] = {"settings": asdict(whole), "random": {}, "seeds": {}, "test": {}}
    for split in ("train", "validation"):
        figures["random"][split] = shares(
            evaluate(RandomAgent(), split, arguments.episodes, seed=10_000, num_envs=32, **env_options(whole))
        )
    print("random actions", figures["random"], flush=True)
    minutes = None if arguments.steps else arguments.minutes
    for seed in map(int, arguments.seeds.split(",")):
        learn(replace(whole, seed=seed), minutes, arguments.test, figures, arguments.out)
    if arguments.test and arguments.guided:
        note_test("the rule", make_agent("waypoint"), whole, arguments.test, figures, arguments.out)


def learn(settings: SacSettings, minutes: float | None, test: int, figures: dict[str, Any], out: Path) -> None:
    """Train from one seed; ``figures`` and the file ``out`` get its curve and how it plays test episodes."""
    curve = figures["seeds"][str(settings.seed)] = []

    def note(validation: Validation) -> None:
        row = {name: getattr(validation, name) for name in ("steps", "updates", "seconds")}
        curve.append({**row, **{split: shares(result) for split, result in validation.results.items()}})
        print(settings.seed, curve[-1], flush=True)
        write_results(out, figures, ("stable-baselines3", "torch", "mujoco"))

    with tempfile.TemporaryDirectory() as folder:
        train_sac(settings, folder, time_limit=None if minutes is None else 60 * minutes, tell=note)
        if test:
            note_test(f"seed {settings.seed}", Sb3Agent(load_sac(folder)), settings, test, figures, out)


def note_test(name: str, agent: Agent, settings: SacSettings, test: int, figures: dict[str, Any], out: Path) -> None:
    """Play test episodes of the difficulties that were trained on."""
    options = {key: value for key, value in env_options(settings).items() if key not in agent.env_options}
    result = evaluate(agent, "test", test, seed=0, num_envs=64, **options)
    successes = sum(record.success for record in result.records)
    figures["test"][name] = {**shares(result), "episodes": test, "success_95": wilson_interval(successes, test)}
    print("test", name, figures["test"][name], flush=True)
    write_results(out, figures, ("stable-baselines3", "torch", "mujoco"))


def shares(result: Evaluation) -> dict[str, float]:
    """The shares of episodes that ended so, and their mean number of steps."""
    steps = sum(record.steps for record in result.records) / len(result.records)
    return {
        "success": round(result.success_rate, 3),
        "collision": round(result.collision_rate, 3),
        "steps": round(steps, 3),
    }


if __name__ == "__main__":
    main()
