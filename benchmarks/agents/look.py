"""Share of the ripe fruit of stands that is found after 1, 3, 5 and 10 views, by planned, fixed and random views.

python -m benchmarks.agents.look --episodes 308 --workdir /tmp/look
python -m benchmarks.agents.look --split train --episodes 20 --agents next-best-view --results /tmp/look.json

The stands are those of a split of a bank, in the true rows. They are looked at in a shuffled order, each as often as
any other. Further rounds repeat them with other random choices of the agents, or with ``--moved`` after the plants
moved. Intervals are 95 % bootstrap intervals over the stands. Records are kept below ``--workdir``, so an interrupted
run resumes. An episode of ten views takes one to two seconds of processor time.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import RESULTS, add_workdir, kept_or_temporary, parser, rate, table, write_entry
from greenhouse_gym.agents import FixedViewsAgent, NextBestViewAgent, RandomViewsAgent
from greenhouse_gym.agents.looking import LookingAgent
from greenhouse_gym.common.executors import processes
from greenhouse_gym.envs.tasks.look import REPORTED_VIEWS
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.evaluation.journal import RecordJournal
from greenhouse_gym.evaluation.leaderboard import TRACKS
from greenhouse_gym.evaluation.records import Record
from greenhouse_gym.scene import SceneBank

AGENTS: dict[str, type[LookingAgent]] = {
    agent.name: agent for agent in (NextBestViewAgent, FixedViewsAgent, RandomViewsAgent)
}
RESAMPLES = 2000


def main() -> None:
    """Look, print and write the figures."""
    command = parser(__doc__)
    command.add_argument("--bank", default="default")
    command.add_argument("--split", default="test")
    command.add_argument("--episodes", type=int, default=308)
    command.add_argument("--seed", type=int, default=0)
    command.add_argument("--moved", action="store_true", help="the plants move before every episode")
    command.add_argument("--agents", nargs="+", choices=AGENTS, default=list(AGENTS))
    command.add_argument("--workers", type=int, default=1, help="processes")
    command.add_argument("--results", type=Path, default=RESULTS / "look.json")
    add_workdir(command)
    given = command.parse_args()
    bank, track = SceneBank.open(given.bank), "moved" if given.moved else "truth"
    names = np.random.default_rng(given.seed).permutation(bank.names(given.split)).tolist()
    problems = [(names[k % len(names)], 0) for k in range(given.episodes)]
    rows = []
    with kept_or_temporary(given.workdir) as folder, processes(given.workers) as executor:
        folder.mkdir(parents=True, exist_ok=True)
        for name in given.agents:
            settings = {"bank": given.bank, "split": given.split, "seed": given.seed, "track": track, "agent": name}
            journal = RecordJournal(folder / f"{given.split}-{track}-{given.seed}-{name}.jsonl", settings)
            found = evaluate(
                AGENTS[name](max(REPORTED_VIEWS)), given.split, seed=given.seed, problems=problems, journal=journal,
                executor=executor, bank=bank, task="look", **TRACKS[track],
            )  # fmt: skip
            figures = settings | summary(found.records, lambda scene: bank.scene(scene).provenance.source or "?")
            write_entry(given.results, f"{given.split}, {track}, {name}", figures)
            every = figures["all"]
            rows.append([name, every["episodes"], *(shown(every[f"fraction_{k}"]) for k in REPORTED_VIEWS)])
    print(table(["agent", "episodes", *(f"{k} views" for k in REPORTED_VIEWS)], rows))


def summary(records: Sequence[Record], source: Any) -> dict[str, Any]:
    """Return the figures of all stands and of those of each source of plants."""
    groups = {"all": list(records)}
    for record in records:
        groups.setdefault(source(record.scene), []).append(record)
    return {name: figures(group) for name, group in groups.items()}


def figures(records: Sequence[Record]) -> dict[str, Any]:
    """Return fractions with intervals, rates and times of episodes."""
    stands = sorted({record.scene for record in records})
    found = np.array([[record.measures[f"fraction_{k}"] for k in REPORTED_VIEWS] for record in records])
    means = np.array([found[[record.scene == stand for record in records]].mean(axis=0) for stand in stands])
    picks = np.random.default_rng(0).integers(len(stands), size=(RESAMPLES, len(stands)))
    low, high = np.percentile(means[picks].mean(axis=1), [2.5, 97.5], axis=0)
    fractions = {
        f"fraction_{k}": [round(float(value), 4) for value in (means[:, i].mean(), low[i], high[i])]
        for i, k in enumerate(REPORTED_VIEWS)
    }
    collisions = sum(record.collision for record in records)
    return {
        "episodes": len(records), "stands": len(stands), **fractions,
        "all_found_within_10": rate(sum(record.success for record in records), len(records)),
        "collisions": rate(collisions, len(records)),
        "ripe": round(float(np.mean([record.measures["ripe"] for record in records])), 1),
        "steps_to_all": float(np.median([record.steps for record in records if record.success] or [np.nan])),
    }  # fmt: skip


def shown(values: Sequence[float]) -> str:
    """Return a fraction with its interval as text."""
    return f"{values[0]:.1%} [{values[1]:.1%}, {values[2]:.1%}]"


if __name__ == "__main__":
    main()
