"""What a planner reaches that knows the true rows: what the leaderboard's truth track is to be held against.

python benchmarks/truth_ceiling.py --checks 100000 --attempts 2

The episodes are those of an entry of the leaderboard. RRTConnect gets the scene's truth in place of its reconstruction,
and for a target the true tomato nearest to it; one that is farther than `SAME` from all of them is a false tomato. A
path that it finds would hold in the episode, since there it is proven free. No path within the checks, from none of
the seeds, is no proof that there is none. Beside this stands what the entry's agent, which does not know the truth,
reached in the same episodes.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from capture_protocols import SAME
from policies import kinds_of_rows
from results_file import RESULTS, write_results

from greenhouse_gym.common.executors import completed, processes
from greenhouse_gym.evaluation import wilson_interval
from greenhouse_gym.evaluation.leaderboard import read_entry
from greenhouse_gym.evaluation.records import Record
from greenhouse_gym.planning import plan
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.truth import true_scene

FALSE_TOMATO = "false tomato"


def main() -> None:
    """Plan every episode and write the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--entry", type=Path, default=Path("benchmarks/leaderboard/watchful.json"))
    parser.add_argument("--episodes", type=int, default=1000, help="the first ones of the entry")
    parser.add_argument("--checks", type=int, default=100_000, help="collision checks of a plan")
    parser.add_argument("--attempts", type=int, default=2, help="plans at most, each from another seed")
    parser.add_argument("--workers", type=int, default=2)
    a = parser.parse_args()
    entry = read_entry(a.entry)
    records = entry.evaluation("truth").records[: a.episodes]
    bank = SceneBank.open(entry.protocol["bank"])
    reached = {record.seed: record.success for record in records}
    found: dict[int, tuple[Record, str]] = {}
    with processes(a.workers) as executor:
        for record, status in completed(
            partial(planned, bank=bank.path, checks=a.checks, attempts=a.attempts), records, executor
        ):
            found[record.seed] = record, status
            if len(found) % 50 == 0:
                solved = sum(status == "solved" for _, status in found.values())
                print(f"{len(found)} of {len(records)} episodes, {solved} with a path", flush=True)
    kinds = kinds_of_rows(bank)
    groups: dict[str, list[tuple[Record, str]]] = {"all": list(found.values())}
    for record, status in found.values():
        groups.setdefault(kinds[record.scene], []).append((record, status))
    result = {name: shares(group, reached) for name, group in sorted(groups.items())}
    for name, figures in result.items():
        print(name, figures)
    options = f"--episodes {a.episodes} --checks {a.checks} --attempts {a.attempts}"
    about = {"command": f"benchmarks/truth_ceiling.py {options}"}
    about |= {"entry": entry.agent, "bank_sha256": entry.bank_sha256}
    write_results(RESULTS / "truth_ceiling.json", {**about, "rows": result}, ["mujoco", "ompl"])


def planned(record: Record, bank: Path, checks: int, attempts: int) -> tuple[Record, str]:
    """What became of the search for a path in the truth of an episode."""
    return record, path_in_truth(SceneBank.open(bank).scene(record.scene), record.target, record.seed, checks, attempts)


def path_in_truth(
    scene: Scene, target: int, seed: int, checks: int = 100_000, attempts: int = 2, start: str | None = None
) -> str:
    """The status of the search for a path to a tomato among the true shapes; "solved" where there is one."""
    true = true_scene(scene)
    gaps = np.linalg.norm(np.array([tomato.center for tomato in true.tomatoes]) - scene.tomatoes[target].center, axis=1)
    if gaps.min() > SAME:
        return FALSE_TOMATO
    for attempt in range(attempts):
        status = plan(
            true, int(gaps.argmin()), time_limit=None, max_checks=checks, seed=seed + attempt, start=start
        ).status
        if status == "solved":
            break
    return status


def shares(group: list[tuple[Record, str]], reached: dict[int, bool]) -> dict[str, Any]:
    """How many episodes ended how, and how many of them the agent of the entry reached."""
    statuses = [status for _, status in group]
    solved = [record for record, status in group if status == "solved"]
    return {
        "episodes": len(group),
        "path in the truth": round(len(solved) / len(group), 4),
        "path in the truth, 95 %": [round(bound, 4) for bound in wilson_interval(len(solved), len(group))],
        "statuses": {status: statuses.count(status) for status in sorted(set(statuses))},
        "agent reached": round(sum(reached[record.seed] for record, _ in group) / len(group), 4),
        "agent reached where there is a path": round(
            sum(reached[record.seed] for record in solved) / max(1, len(solved)), 4
        ),
    }


if __name__ == "__main__":
    main()
