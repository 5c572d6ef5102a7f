"""Write the table of results in README.md from the files in benchmarks/results/.

python -m benchmarks.readme_table
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from benchmarks.common import RESULTS, ROOT, table
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.evaluation.entry import is_current, read_entry
from greenhouse_gym.evaluation.records import wilson_interval

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
    """Return what an agent of the leaderboard reaches in the true test rows of the bank that is shipped now."""
    entry = read_entry(ROOT / "benchmarks" / "leaderboard" / f"{agent}.json")
    if not is_current(entry):
        raise SystemExit(f"{agent}.json: played on another bank; run greenhouse-gym submit {agent}")
    truth = entry.evaluation("truth")
    return percent(truth.success_rate, len(truth.records))


def harvested() -> str:
    """Return what the scanning harvester crates of the ripe fruit of true test stands."""
    entry = read("harvest.json")["entries"]["test, stand, harvest-scan"]
    rate, low, high = (100 * value for value in entry["harvested"])
    return f"**{rate:.0f} %** [{low:.0f}, {high:.0f}] of {entry['fruit']:,}"


def lesson() -> str:
    """Return what the ten lines reach on easy targets of own test rows, over all seeds."""
    return pooled(read("first_lesson.json")["entries"]["ten lines"]["seeds"].values())


def with_goals(rows: str) -> str:
    """Return what the shipped policy that chooses goals reaches behind the shield of all targets of some test rows."""
    cell = read("cells.json")["entries"]["ppo-goals-ur5e"][f"shielded, {rows}, all"]
    return percent(cell["success"], cell["episodes"])


def pooled(seeds: Iterable[dict[str, Any]]) -> str:
    """Return what policies of several seeds reach together on easy targets of own test rows."""
    cells = [entry["alone, own, easy"] for entry in seeds]
    return percent(float(np.mean([cell["success"] for cell in cells])), sum(cell["episodes"] for cell in cells))


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
        ("[reached in the true row](docs/results/agents.md), trusting the scan (`RRTConnect`)", reached("RRTConnect")),
        ("[reached in the true row](docs/results/agents.md), looking first (`watchful`)", reached("watchful")),
        (
            "the same, rehearsing a policy instead of planning (`watchful-ppo-goals-ur5e`)",
            reached("watchful-ppo-goals-ur5e"),
        ),
        ("[ripe fruit crated](docs/results/harvest.md) in true stands, by scan and wrist camera", harvested()),
        ("[learned in 4 minutes on one core](docs/results/learning.md), easy own targets, as scanned", lesson()),
        (
            "[in 25 minutes](docs/results/learning.md#with-a-goal-configuration), behind a shield, all own targets",
            with_goals("own"),
        ),
        ("the same, all targets of dense Helios rows", with_goals("helios")),
        ("[steps per second](docs/results/speed.md), 256 simulations on two cores", speed()),
    ]
    text = table(("what", "figure"), rows, "---")
    print(text)
    pattern = f"(?s){re.escape(BEGIN)}.*{re.escape(END)}"
    write_atomically(README, re.sub(pattern, lambda _: f"{BEGIN}\n\n{text}\n\n{END}", README.read_text()))


if __name__ == "__main__":
    main()
