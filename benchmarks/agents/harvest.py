"""Harvests by an agent: fruit an hour, success, losses and damage per 100 fruit.

python -m benchmarks.agents.harvest --sizes pick stand --episodes 100 --workdir /tmp/harvest
python -m benchmarks.agents.harvest --entry benchmarks/leaderboard/harvest-scan.json
python -m benchmarks.agents.harvest --agent ppo-pick-ur5e --sizes pick --episodes 500 --seed 20000
python -m benchmarks.agents.harvest --sizes row --episodes 20 --workdir /tmp/harvest
python -m benchmarks.agents.harvest --agent truss-cutter --sizes truss --episodes 100 --workdir /tmp/harvest
python -m benchmarks.agents.harvest --bank mini --split train --sizes pick --episodes 4 --results /tmp/harvest.json

Episodes take place in the true rows of a split, with compliant plants; each draws its scene and fruit from its seed.
Intervals are 95 % bootstrap intervals over the episodes. Records are kept below ``--workdir``, so an interrupted run
resumes. The oracle knows the true plants as they hang, so its figures bound those of agents that have to see, such as
harvest-scan. With ``--entry`` the episodes are those of an entry of the leaderboard, and nothing is evaluated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.common import RESULTS, add_workdir, kept_or_temporary, parser, table, write_entry
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.envs.tasks.harvest import SIZES
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.evaluation.entry import HARVEST
from greenhouse_gym.evaluation.harvest import METRICS, harvest_metrics
from greenhouse_gym.evaluation.journal import RecordJournal
from greenhouse_gym.evaluation.leaderboard import TRACKS, read_entry
from greenhouse_gym.evaluation.records import Record
from greenhouse_gym.robots import mount_on_rail

STEP_LIMITS = {"pick": 400, "truss": 2400, "stand": TRACKS["harvest"]["step_limit"], "row": 9000}
"""Shorter than the task's: an agent that has given up only waits."""


def main() -> None:
    """Harvest, print and write the figures."""
    command = parser(__doc__)
    command.add_argument(
        "--agent", choices=("harvest-oracle", "harvest-scan", "truss-cutter", "ppo-pick-ur5e"), default="harvest-oracle"
    )
    command.add_argument("--bank", default="default")
    command.add_argument("--split", default="test")
    command.add_argument("--sizes", nargs="+", choices=SIZES, default=["pick", "stand"])
    command.add_argument("--episodes", type=int, default=100)
    command.add_argument("--seed", type=int, default=0)
    command.add_argument("--results", type=Path, default=RESULTS / "harvest.json")
    command.add_argument("--entry", type=Path, help="entry of the leaderboard")
    add_workdir(command)
    given = command.parse_args()
    if given.entry:
        entry = read_entry(given.entry)
        about = {name: entry.protocol[name] for name in ("bank", "split", "seed")} | {"size": "stand"}
        row = _written(given.results, about, entry.agent, entry.evaluation(HARVEST).records)
        print(table(["size", "episodes", "fruit", *METRICS], [row]))
        return
    rows = []
    with kept_or_temporary(given.workdir) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        for size in given.sizes:
            settings = {"bank": given.bank, "split": given.split, "seed": given.seed, "size": size}
            agent = make_agent(given.agent)
            file = folder / f"{agent.name}-{given.bank}-{given.split}-{given.seed}-{size}.jsonl"
            journal = RecordJournal(file, settings | {"agent": agent.name})
            options = {"size": size} if agent.env_options["task"] == "harvest" else {}  # the cutter's task has its size
            if size == "row":
                options["robot"] = str(mount_on_rail("ur5e", folder / "ur5e-rail.xml"))
            found = evaluate(
                agent, given.split, given.episodes, given.seed, journal=journal, bank=given.bank,
                step_limit=STEP_LIMITS[size], **options, **agent.env_options,
            )  # fmt: skip
            rows.append(_written(given.results, settings, agent.name, found.records))
    print(table(["size", "episodes", "fruit", *METRICS], rows))


def _written(results: Path, settings: Mapping[str, Any], agent: str, records: Sequence[Record]) -> list[str | int]:
    """Write the figures of an agent's episodes and return them as a row."""
    metrics = harvest_metrics(records)
    fruit = int(sum(record.measures["wanted"] for record in records))
    figures = {name: [round(value, 4) for value in values] for name, values in metrics.items()}
    entry = dict(settings) | {
        "agent": agent, "world": "truth, compliant", "episodes": len(records), "fruit": fruit,
        "collisions": sum(record.collision for record in records), **figures,
    }  # fmt: skip
    write_entry(results, f"{settings['split']}, {settings['size']}, {agent}", entry)
    return [settings["size"], len(records), fruit, *(shown(metrics[name]) for name in METRICS)]


def shown(values: tuple[float, float, float]) -> str:
    """Return a figure with its interval as text."""
    return f"{values[0]:.3g} [{values[1]:.3g}, {values[2]:.3g}]"


if __name__ == "__main__":
    main()
