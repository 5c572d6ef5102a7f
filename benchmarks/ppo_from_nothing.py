"""What PPO learns from nothing: success and collisions on rows it has not seen, and learning curves, by training seed.

python benchmarks/ppo_from_nothing.py --seeds 0,1,2 --out-folder runs/ppo-from-nothing --splits validation,test

Trains once for each seed with the usual settings of ``greenhouse-gym train ppo``; a training that is there is gone on
with, or only judged where it is done. Judged is the policy without its noise, alone and behind the shield, on the same
episodes for all seeds: 500 of the validation rows, and the leaderboard's 1,000 of the test rows.
Writes results/ppo_from_nothing.json after each seed, and a picture of the curves beside it; other seeds that the file
holds stay, if they were trained on the same bank with the same settings.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from imitation import FIRST_SEED
from policies import rates
from results_file import RESULTS, kept_results, write_results

from greenhouse_gym.agents import PolicyAgent, ShieldedAgent
from greenhouse_gym.common.settings_files import resolve
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.learning import PpoSettings, train_ppo
from greenhouse_gym.learning.training_files import CHECKPOINT, CURVE, VALIDATION, read_curve
from greenhouse_gym.scene import SceneBank

EPISODES = {"validation": (500, FIRST_SEED), "test": (1000, 0)}
"""How many episodes of a split, and the seed of the first."""

EVERY = 8
"""Of so many lines of a learning curve, one is kept."""

USUAL = PpoSettings(validation_steps=500_000, validation_episodes=200)


def main() -> None:
    """Train, play, write the figures and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--splits", default="validation")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--out-folder", type=Path, default=Path("runs/ppo-from-nothing"))
    parser.add_argument("--out", type=Path, default=RESULTS / "ppo_from_nothing.json")
    arguments = parser.parse_args()
    settings = resolve(USUAL, None, arguments.set)
    bank = SceneBank.open(settings.bank)
    about = {"settings": asdict(settings), "bank_sha256": bank.sha256, "episodes": EPISODES}
    figures: dict[str, Any] = about | kept_results(arguments.out, about, ["seeds"])
    for seed in arguments.seeds.split(","):
        folder = arguments.out_folder / f"seed-{seed}"
        path = train_ppo(replace(settings, seed=int(seed)), folder, resume=(folder / CHECKPOINT).is_file())
        policy, curve = PolicyAgent.load(path), read_curve(folder / CURVE)
        entry = figures["seeds"].setdefault(seed, {}) | {
            "seconds": curve[-1]["seconds"], "curve": curve[EVERY - 1 :: EVERY],
            "validation": read_curve(folder / VALIDATION),
        }  # fmt: skip
        for split, agent in product(arguments.splits.split(","), (policy, ShieldedAgent(policy))):
            episodes, first = EPISODES[split]
            played = evaluate(agent, split, episodes, first, bank=bank, num_envs=64, threads=1)
            entry[f"{'shielded' if agent is not policy else 'alone'}, {split}"] = rates(played, bank)
        figures["seeds"][seed] = entry
        write_results(arguments.out, figures, ("stable-baselines3", "torch", "mujoco"))
        draw(figures["seeds"], arguments.out.with_suffix(".png"))


def draw(seeds: dict[str, Any], path: Path) -> None:
    """The successes of each training, with its noise, and of its policy without noise on rows it has not seen."""
    figure, axes = plt.subplots(figsize=(7, 3.6), layout="constrained")
    for k, (seed, entry) in enumerate(sorted(seeds.items())):
        for name, style in (("curve", "-"), ("validation", "o--")):
            line = entry[name]
            label = f"seed {seed}, {'training rows' if name == 'curve' else 'validation rows, without noise'}"
            axes.plot(
                [point["steps"] / 1e6 for point in line], [point["success_rate"] for point in line], style,
                color=f"C{k}", label=label, linewidth=1.2, markersize=4,
            )  # fmt: skip
    axes.set(xlabel="million steps", ylabel="tomatoes reached", ylim=(0, 1), title="PPO from nothing")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    main()
