"""The table of results in README.md, written anew from the files in benchmarks/results/.

    python benchmarks/readme_table.py

A file that is missing gives no row; figures of policies count only for the bank that is shipped now.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from results_file import RESULTS

from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.evaluation.records import wilson_interval
from greenhouse_gym.scene import SceneBank

README = RESULTS.parent.parent / "README.md"
BEGIN, END = "<!-- --8<-- [start:results] -->", "<!-- --8<-- [end:results] -->"
USUAL = ("package", False, 5, 0.002)
"""Method, whether stations are broken, length and error of the cameras, metres, of the rows that count."""

NAMES = {"own": "own", "helios": "Helios"}

TOLD = (
    "hybrid, reconstruction",
    "ppo-waypoint-ur5e, truth",
    "ppo-scratch-ur5e, reconstruction",
    "watchful, truth",
)
"""Agents and worlds that README tells of; the file holds the others."""

LEAST = 30
"""Paths that must have been followed for a rate to count."""

UNKNOWN = {"free": "unknown space taken as free", "avoid": "unknown space avoided", "forbid": "unknown space forbidden"}


def read(name: str) -> Any:
    """A results file; None where it is missing."""
    path = RESULTS / name
    return json.loads(path.read_text()) if path.is_file() else None


def share(count: int, total: int) -> str:
    """A share with its interval."""
    low, high = wilson_interval(count, total)
    return f"{count / total:.0%} [{low:.0%}, {high:.0%}]"


def shapes(name: str, rows: str, command: str) -> Iterator[str]:
    """Tomatoes found in held-out rows."""
    if results := read(name):
        found = results["figures"]["noisy"]["tomatoes"]["all"]
        false = found["false"]
        yield (
            f"| visible tomatoes found, {len(results['seeds'])} {rows} | {share(found['found'], found['visible'])} of "
            f"{found['visible']}, {false} false | `{command}` |"
        )


def plans() -> Iterator[str]:
    """Plans made on the scan and followed in the truth: the way that holds best, and the paper's for comparison."""
    figures = (read("careful_plans.json") or {"figures": []})["figures"]
    followed = [figure for figure in figures if figure["followed"] >= LEAST]
    for source in dict.fromkeys(figure["source"] for figure in followed):
        own = [figure for figure in followed if figure["source"] == source]
        best = max(own, key=lambda figure: float(figure["reached"]["interval"][0]))
        plain = [figure for figure in own if (figure["protocol"], figure["unknown"]) == ("paper", "free")]
        for figure in [best, *(figure for figure in plain if figure is not best)]:
            reached, collided = figure["reached"], figure["collided"]
            low, high = reached["interval"]
            where = f"{figure['rows']} held-out {NAMES[source]} rows, protocol {figure['protocol']}"
            unknown = UNKNOWN.get(str(figure["unknown"]), f"at most {figure['unknown']} m deep into unknown space")
            yield (
                f"| plans that hold in the truth, {where}, {unknown} | "
                f"{reached['rate']:.0%} [{low:.0%}, {high:.0%}] of {figure['followed']} reach, {collided['rate']:.0%} "
                f"collide; {figure['targets'] - figure['followed']} of {figure['targets']} have no plan | "
                "`benchmarks/careful_plans.py` |"
            )


def policies() -> Iterator[str]:
    """Agents on the test rows of the bank that is shipped now."""
    agents, shipped = (read("policies.json") or {"agents": {}})["agents"], SceneBank.open("default").sha256
    for name in (name for name in TOLD if name in agents and agents[name]["bank_sha256"] == shipped):
        record = agents[name]
        low, high = record["success_95"]
        yield (
            f"| {name}, {record['episodes']} episodes of the test rows | {record['success']:.1%} [{low:.1%}, "
            f"{high:.1%}] reach, {record['collision']:.0%} collide | `benchmarks/policies.py` |"
        )


def learned() -> Iterator[str]:
    """What PPO learned from nothing on the bank that is shipped now, by training seed."""
    results = read("ppo_from_nothing.json")
    if not results or results["bank_sha256"] != SceneBank.open("default").sha256:
        return
    seeds = [entry for _, entry in sorted(results["seeds"].items()) if "shielded, test" in entry]
    if not seeds:
        return
    steps, episodes = results["settings"]["total_steps"], results["episodes"]["test"][0]

    def rates(agent: str) -> str:
        reached, collided = (
            ", ".join(f"{seed[f'{agent}, test'][name]:.1%}" for seed in seeds) for name in ("success", "collision")
        )
        return f"{reached} reach, {collided} collide"

    yield (
        f"| PPO from nothing, {steps / 1e6:.0f} million steps, {len(seeds)} training seeds, reconstruction, {episodes} "
        f"episodes of the test rows | {rates('alone')}; behind the shield {rates('shielded')} | "
        "`benchmarks/ppo_from_nothing.py` |"
    )


def reconstruction() -> Iterator[str]:
    """How straight and how near to the truth rows are."""
    if results := read("reconstruction.json"):
        rows = [m for m in results["measurements"] if (m["method"], m["broken"], m["length"], m["bias"]) == USUAL]
        if rows:
            drift = np.array([row["drift"] for row in rows])
            mean = np.array([row["distance_mean"] for row in rows])
            yield (
                f"| drift of 5 m rows, cloud to truth; {len(rows)} own rows | {np.median(drift):.2%} (to "
                f"{drift.max():.2%}), {1e3 * np.median(mean):.1f} mm (to {1e3 * mean.max():.1f}) | "
                "`benchmarks/reconstruction.py` |"
            )


def throughput() -> Iterator[str]:
    """Speed, beside another environment on the same machine."""
    if results := read("throughput.json"):
        ratio, rate = results["ratios"], results["per_second"]["vector environment"]
        yield (
            f"| steps per second of {results['num_envs']} simulations, two cores | "
            f"{rate:,}, {ratio['vector environment / bare Batch.step']:.0%} of bare MuJoCo, "
            f"{ratio['vector environment / FetchReach-v4 AsyncVectorEnv(8)']:.0f} times FetchReach-v4; "
            f"touching the truth, 64 make {ratio['physics truth / reconstruction']:.0%} of what they make otherwise | "
            "`benchmarks/throughput.py` |"
        )


def table() -> str:
    """All rows."""
    rows = [
        *shapes("shapes_helios.json", "held-out Helios rows", "benchmarks/shapes.py --source helios"),
        *shapes("shapes.json", "held-out own rows", "benchmarks/shapes.py"),
        *plans(),
        *policies(),
        *learned(),
        *reconstruction(),
        *throughput(),
    ]
    return "\n".join(["| what | figure [95 %] | printed by |", "|---|---|---|", *rows])


def main() -> None:
    """Print the table and write it into README.md."""
    text = README.read_text()
    new = re.sub(f"(?s){re.escape(BEGIN)}.*{re.escape(END)}", f"{BEGIN}\n\n{table()}\n\n{END}", text)
    print(table())
    write_atomically(Path(README), new)


if __name__ == "__main__":
    main()
