"""Write the table of results in README.md from the files in benchmarks/results/.

python -m benchmarks.readme_table

A missing file gives no row; figures of policies count only for the bank that is shipped now.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.common import RESULTS, ROOT, percent, rate, table
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.scene import SceneBank

README = ROOT / "README.md"
BEGIN, END = "<!-- --8<-- [start:results] -->", "<!-- --8<-- [end:results] -->"
AGENTS = (
    "hybrid, reconstruction",
    "ppo-roadmap-ur5e, truth",
    "ppo-roadmap-scratch-ur5e, reconstruction",
    "watchful, truth",
)
"""Agents and worlds in README; the file holds the others."""
PLANS = {
    "plans, test rows, unknown=0.15, folded": "at most 0.15 m deep into unknown space",
    "plans, test rows, unknown=free, folded": "unknown space taken as free",
}
"""Plans in the true rows, the cautious ones first."""
ROWS = {"own, upright-back": 0, "own, paper": 1, "helios, upright-back": 0, "helios, paper": 1}
"""Kinds of rows in README, each with the number of its plans in `PLANS`."""
Row = tuple[str, str, str]


def read(name: str) -> dict[str, Any]:
    """Return a file of results; an empty one if it is missing."""
    path = RESULTS / name
    return json.loads(path.read_text()) if path.is_file() else {}


def shapes(name: str, rows: str, options: str) -> Iterator[Row]:
    """Yield the tomatoes found in held-out rows."""
    if results := read(name):
        found = results["figures"]["noisy"]["tomatoes"]["all"]
        text = percent(rate(found["found"], found["visible"]), 0)
        yield (
            f"visible tomatoes found, {len(results['seeds'])} {rows}",
            f"{text} of {found['visible']}, {found['false']} false",
            f"benchmarks/sensing/shapes.py{options}",
        )


def plans() -> Iterator[Row]:
    """Yield plans made on scans and followed in the true rows: by the better protocol, and by the paper's."""
    entries = read("true_rows.json").get("entries", {})
    for rows, k in ROWS.items():
        name, unknown = list(PLANS.items())[k]
        if name not in entries:
            continue
        figures = entries[name]["by_rows"][rows]
        source, protocol = rows.replace("helios", "Helios").split(", ")
        found = figures["of_planned"]
        low, high = found["success_95"]
        yield (
            f"plans that hold in the truth, {figures['recordings']} held-out {source} rows, protocol {protocol}, "
            f"{unknown}",
            f"{found['success']:.0%} [{low:.0%}, {high:.0%}] of {found['episodes']} reach, {found['collision']:.0%} "
            f"collide; no plan exists for {figures['episodes'] - found['episodes']} of {figures['episodes']}",
            "benchmarks/agents/true_rows.py",
        )


def policies() -> Iterator[Row]:
    """Yield agents on the test rows of the bank that is shipped now."""
    entries, shipped = read("policies.json").get("entries", {}), SceneBank.open("default").sha256
    for name in (name for name in AGENTS if name in entries and entries[name]["bank_sha256"] == shipped):
        entry = entries[name]
        low, high = entry["success_95"]
        yield (
            f"{name}, {entry['episodes']} episodes of the test rows",
            f"{entry['success']:.1%} [{low:.1%}, {high:.1%}] reach, {entry['collision']:.0%} collide",
            "benchmarks/agents/policies.py",
        )


def reconstruction() -> Iterator[Row]:
    """Yield drift and distance to the truth of rows of 5 m."""
    usual = {"method": "package", "broken": False, "length": 5}
    rows = [m for m in read("reconstruction.json").get("measurements", []) if usual.items() <= m.items()]
    if rows:
        drift, mean = np.array([row["drift"] for row in rows]), np.array([1e3 * row["distance_mean"] for row in rows])
        yield (
            f"drift of 5 m rows, cloud to truth; {len(rows)} own rows",
            f"{np.median(drift):.2%} (to {drift.max():.2%}), {np.median(mean):.1f} mm (to {mean.max():.1f})",
            "benchmarks/sensing/reconstruction.py",
        )


def throughput() -> Iterator[Row]:
    """Yield the speed next to another environment on the same machine."""
    if results := read("throughput.json"):
        ratio, speed = results["ratios"], results["per_second"]["vector environment"]
        yield (
            f"steps per second of {results['num_envs']} simulations, two cores",
            f"{speed:,}, {ratio['vector environment / bare Batch.step']:.0%} of bare MuJoCo, "
            f"{ratio['vector environment / FetchReach-v4 AsyncVectorEnv(8)']:.0f} times FetchReach-v4; with the truth "
            f"as the world, 64 make {ratio['physics truth / reconstruction']:.0%} of that in the reconstruction",
            "benchmarks/speed/throughput.py",
        )


def main() -> None:
    """Print the table and write it into README.md."""
    rows = [
        *shapes("shapes_helios.json", "held-out Helios rows", " --source helios"),
        *shapes("shapes.json", "held-out own rows", ""),
        *plans(),
        *policies(),
        *reconstruction(),
        *throughput(),
    ]
    text = table(
        ("measured", "figure [95 %]", "printed by"), [(what, figure, f"`{by}`") for what, figure, by in rows], "---"
    )
    print(text)
    pattern = f"(?s){re.escape(BEGIN)}.*{re.escape(END)}"
    write_atomically(README, re.sub(pattern, f"{BEGIN}\n\n{text}\n\n{END}", README.read_text()))


if __name__ == "__main__":
    main()
