"""Write the table of results in README.md from the files in benchmarks/results/.

python -m benchmarks.readme_table
"""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np

from benchmarks.common import RESULTS, ROOT, table
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.evaluation.records import wilson_interval
from greenhouse_gym.scene import SceneBank

README = ROOT / "README.md"
BEGIN, END = "<!-- --8<-- [start:results] -->", "<!-- --8<-- [end:results] -->"


def read(name: str) -> dict[str, Any]:
    """Return a file of results."""
    content: dict[str, Any] = json.loads((RESULTS / name).read_text())
    return content


def percent(rate: float, episodes: int) -> str:
    """Return a rate with its 95 % interval."""
    low, high = wilson_interval(round(rate * episodes), episodes)
    return f"**{100 * rate:.0f} %** [{100 * low:.0f}, {100 * high:.0f}] of {episodes:,}"


def tomatoes() -> str:
    """Return the visible tomatoes found in held-out Helios rows."""
    found = read("shapes_helios.json")["figures"]["noisy"]["tomatoes"]["all"]
    return percent(found["found"] / found["visible"], found["visible"])


def drift() -> str:
    """Return the drift of rows of 5 m."""
    usual = {"method": "package", "broken": False, "length": 5}
    rows = [row for row in read("reconstruction.json")["measurements"] if usual.items() <= row.items()]
    return f"**{np.median([100 * row['drift'] for row in rows]):.2f} %**, {len(rows)} rows"


def reached(agent: str) -> str:
    """Return what an agent reaches in the true test rows of the bank that is shipped now."""
    entry = read("policies.json")["entries"][f"{agent}, truth"]
    if entry["bank_sha256"] != SceneBank.open("default").sha256:
        raise SystemExit(f"policies.json: {agent} was measured on another bank; run benchmarks.agents.policies")
    return percent(entry["success"], entry["episodes"])


def lesson() -> str:
    """Return what the ten lines reach on easy targets of own test rows, over all seeds."""
    seeds = read("first_lesson.json")["entries"]["ten lines"]["seeds"].values()
    cells = [entry["alone, own, easy"] for entry in seeds]
    return percent(float(np.mean([cell["success"] for cell in cells])), sum(cell["episodes"] for cell in cells))


def gpu() -> str:
    """Return what a policy trained on a GPU reaches on all targets of the test rows."""
    entry = read("gpu.json")["PPO 3x512, tip actions, seed 0, test"]
    return percent(entry["success"], entry["episodes"])


def speed() -> str:
    """Return steps per second next to another environment on the same machine."""
    results = read("throughput.json")
    peer = results["ratios"]["vector environment / FetchReach-v4 AsyncVectorEnv(8)"]
    return f"**{results['per_second']['vector environment']:,}**, {peer:.0f} times FetchReach-v4"


def main() -> None:
    """Print the table and write it into README.md."""
    rows = [
        ("[visible tomatoes found](docs/results/tomatoes.md) in held-out Helios rows", tomatoes()),
        ("[drift](docs/results/drift.md) of a reconstructed row of 5 m", drift()),
        ("[reached in the true row](docs/results/agents.md), trusting the scan (`hybrid`)", reached("hybrid")),
        ("[reached in the true row](docs/results/agents.md), looking first (`watchful`)", reached("watchful")),
        ("[learned in 4 minutes on one core](docs/results/learning.md), easy own targets, as scanned", lesson()),
        ("[learned in 91 s on a GPU](docs/results/learning.md) (`ppo-warp-ur5e`), all targets, as scanned", gpu()),
        ("[steps per second](docs/results/speed.md), 256 simulations on two cores", speed()),
    ]
    text = table(("what", "figure"), rows, "---")
    print(text)
    pattern = f"(?s){re.escape(BEGIN)}.*{re.escape(END)}"
    write_atomically(README, re.sub(pattern, lambda _: f"{BEGIN}\n\n{text}\n\n{END}", README.read_text()))


if __name__ == "__main__":
    main()
