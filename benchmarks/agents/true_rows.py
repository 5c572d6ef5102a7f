"""Let agents that know a scan act in the true row behind it; count success, collisions and missing plans.

python -m benchmarks.agents.true_rows --split test --per-scene 12 --start folded --set unknown=0.15 --set margin=0.01
python -m benchmarks.agents.true_rows --agent watchful --split validation --episodes 500 --seed 20000 --contacts
python -m benchmarks.agents.true_rows --agent watchful --rows 811-820 --source helios --protocol upright-back --search
python -m benchmarks.agents.true_rows --entry benchmarks/leaderboard/watchful.json --search

The rows are those of a bank, or with ``--rows`` rows that are grown, photographed by a protocol, reconstructed and cut
into scenes below ``--workdir``. Episodes are drawn from a split as `evaluate` draws them (``--episodes``), or are up to
``--per-scene`` of the tomatoes within reach, with or without a known path, of every scene in which the arm's start
touches no shape of the scan. A planner plans once on the reconstruction, and its path is followed in the truth.
``--set`` gives an option of the agent's class.

``--search`` also plans for every episode with the truth known, and groups the rates by the status of that search: it
bounds what any agent could reach. ``--contacts`` plays the episodes that ended in a collision once more and counts what
the scan knew of the contact points: the nearest shape and the state of the occupancy grid. A scanned surface with a
shape nearby is the rim of a leaf, against which a margin helps; a scanned surface far from all shapes is missing among
them; against leaves in unknown space only another view helps.

Records are kept below ``--workdir``, so an interrupted run resumes. 500 episodes on two cores take an hour with
`watchful` and five minutes with RRTConnect; a scanned row takes three minutes more.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.agents.policies import kinds_of_rows, rates
from benchmarks.agents.scanned_rows import ScannedRow, row_seeds
from benchmarks.agents.true_row_figures import by_search, path_in_truth, scan_state, summary
from benchmarks.common import RESULTS, parser, write_entry
from greenhouse_gym.agents import PlannerAgent, WatchfulAgent
from greenhouse_gym.agents.agent import Agent
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.common.executors import completed, processes
from greenhouse_gym.envs import PlantMotion, Randomization
from greenhouse_gym.evaluation import evaluate, retrace
from greenhouse_gym.evaluation.journal import RecordJournal
from greenhouse_gym.evaluation.leaderboard import read_entry
from greenhouse_gym.evaluation.records import Record
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank, compile_scene

ROBOT = "ur5e"
REACH = 0.95
"""Maximum distance of a target from the shoulder, m."""


def main() -> None:
    """Play, print and write the figures."""
    command = parser(__doc__)
    command.add_argument("--agent", default="RRTConnect")
    command.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="option of the agent")
    command.add_argument("--entry", type=Path, help="take the episodes of a leaderboard entry instead of playing")
    command.add_argument("--bank", default="default")
    command.add_argument("--split", default="validation")
    command.add_argument("--rows", type=row_seeds, help="seeds of rows to scan, such as 811-820")
    command.add_argument("--source", default=ScannedRow.source, help="own or helios")
    command.add_argument("--protocol", default="upright-back")
    command.add_argument("--length", type=float, default=1.5, help="of a scanned row, m")
    command.add_argument("--spacing", type=float, default=0.25, help="between arm placements, m")
    command.add_argument("--per-scene", type=int, default=12, help="targets within reach of each scene")
    command.add_argument("--episodes", type=int, help="episodes drawn from the split instead")
    command.add_argument("--seed", type=int, default=0, help="of the first episode")
    command.add_argument("--start", help="start configuration, such as folded; that of the environment when left out")
    command.add_argument("--moved", action="store_true", help="the plants have moved since they were scanned")
    command.add_argument("--noise", action="store_true", help="add the noise of a D435 to the arm's camera")
    command.add_argument("--search", action="store_true", help="plan with the truth known")
    command.add_argument("--contacts", action="store_true", help="count what the scan knew of contact points")
    command.add_argument("--workers", type=int, default=2)
    command.add_argument("--workdir", type=Path, default=Path("runs/true_rows"))
    command.add_argument("--name", help="of the entry in the file of results")
    command.add_argument("--out", type=Path, default=RESULTS / "true_rows.json")
    a = command.parse_args()
    if a.contacts and (a.episodes is None or a.rows):
        command.error("--contacts needs --episodes of a bank")
    options = options_from(a.set)
    world: dict[str, Any] = {"physics": "truth", "start": a.start or "upright"}
    if a.moved or a.noise:
        world["randomization"] = Randomization(plants=PlantMotion() if a.moved else None, depth_noise=a.noise)
    records: list[Record] = []
    found: list[str] = []
    kinds: dict[str, str] = {}
    figures: dict[str, Any] = {}
    with processes(a.workers) as executor:
        for bank in banks(a):
            own = entry_records(a.entry) if a.entry else play(a, options, bank, world, executor)
            records, kinds = [*records, *own], kinds | kinds_of_rows(bank)
            figures = {"bank_sha256": bank.sha256} | summary(records, kinds)
            if a.search:
                found += searched(own, bank, a.start, executor, a.workdir / f"search-{bank.sha256[:12]}.json")
                figures["search"] = by_search(records, found)
            if a.episodes is not None and not a.rows:
                figures["by_difficulty"] = rates(records, bank)["by_difficulty"]
            if a.contacts:
                seeds = [record.seed for record in own if record.collision]
                traces = retrace(agent_from(a.agent, options), seeds, a.split, bank=bank.path, **world) if seeds else ()
                counts = Counter(scan_state(bank.scene(t.record.scene), t) for t in traces)
                figures["contacts"] = dict(counts.most_common())
            name = a.name or entry_name(a)
            print(name, json.dumps(figures, indent=1), flush=True)
            write_entry(a.out, name, figures)


def banks(a: argparse.Namespace) -> list[SceneBank]:
    """Return the bank that is named, or one bank for each row that is scanned."""
    if not a.rows:
        return [SceneBank.open(read_entry(a.entry).protocol["bank"] if a.entry else a.bank)]
    size = (a.source, a.protocol, a.length, a.spacing)
    return [ScannedRow(seed, *size).bank(a.workdir) for seed in a.rows]


def entry_name(a: argparse.Namespace) -> str:
    """Return a name that holds all choices."""
    rows = f"{a.source} rows {a.rows[0]}-{a.rows[-1]}, {a.protocol}" if a.rows else f"{a.split} rows"
    agent = a.entry.stem if a.entry else a.agent
    switches = [name for name in ("moved", "noise") if getattr(a, name)]
    return ", ".join([agent, *a.set, *filter(None, [a.start]), *switches, rows])


# -- agents and episodes ----------------------------------------------------------------------------------------------


def options_from(pairs: Sequence[str]) -> dict[str, Any]:
    """Parse options such as "margin=0.02", "image=[64, 48]" or "unknown=avoid"."""
    options = {}
    for name, _, text in (pair.partition("=") for pair in pairs):
        try:
            options[name] = json.loads(text)
        except json.JSONDecodeError:
            options[name] = text
    return options


def agent_from(name: str, options: Mapping[str, Any]) -> Agent:
    """Return an agent by name; only `watchful` and planners take options."""
    if not options:
        return make_agent(name)
    return WatchfulAgent(**options) if name == WatchfulAgent.name else PlannerAgent(name, **options)


def entry_records(path: Path) -> list[Record]:
    """Return the records of a leaderboard entry in the truth."""
    return list(read_entry(path).evaluation("truth").records)


def play(
    a: argparse.Namespace, options: Mapping[str, Any], bank: SceneBank, world: Mapping[str, Any], executor: Executor
) -> list[Record]:
    """Play the episodes of a bank, except those whose records are kept."""
    problems = None
    if a.episodes is None:
        scenes = [bank.scene(name) for name in bank.names("test" if a.rows else a.split)]
        usable = [scene for scene in scenes if start_is_free(scene, a.start)]
        problems = [(scene.name, k) for scene in usable for k in within_reach(scene, a.per_scene, a.seed)]
        if not problems:
            return []
    about = {
        "agent": a.agent, "options": options, "bank": bank.sha256, "split": a.split, "problems": problems,
        "seed": a.seed, "world": str(world),
    }  # fmt: skip
    switches = ("moved" * a.moved, "noise" * a.noise)
    name = "-".join(filter(None, [a.agent, *a.set, a.start, *switches, bank.sha256[:8]]))
    journal = RecordJournal(a.workdir / f"{name}.jsonl".replace("/", "_"), about)
    result = evaluate(
        agent_from(a.agent, options), "test" if a.rows else a.split, a.episodes or 1, a.seed, problems=problems,
        bank=bank.path, executor=executor, journal=journal, **world,
    )  # fmt: skip
    return list(result.records)


def start_is_free(scene: Scene, start: str | None) -> bool:
    """Return whether the arm's start touches no shape of the scan."""
    arm = get_robot(ROBOT)
    checker = CollisionChecker(planning_model(compile_scene(scene, arm), target=0), arm_reaches(arm))
    return bool(checker.is_free(arm.configuration(start or "upright")))


def within_reach(scene: Scene, count: int, seed: int) -> list[int]:
    """Draw some of the tomatoes within reach of the arm."""
    shoulder = np.array([0.0, 0.0, scene.placement.shoulder_height])
    near = [k for k, tomato in enumerate(scene.tomatoes) if np.linalg.norm(tomato.center - shoulder) < REACH]
    return np.random.default_rng(seed).permutation(near)[:count].astype(int).tolist()


# -- the search with the truth known ----------------------------------------------------------------------------------


def searched(
    records: Sequence[Record], bank: SceneBank, start: str | None, executor: Executor, file: Path
) -> list[str]:
    """Return the status of the search in the truth for each episode; statuses are kept in a file."""
    known: dict[str, str] = json.loads(file.read_text()) if file.exists() else {}
    missing = [record for record in records if _key(record, start) not in known]
    for key, status in completed(partial(_search, bank=bank.path, start=start), missing, executor):
        known[key] = status
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(known))
    return [known[_key(record, start)] for record in records]


def _key(record: Record, start: str | None) -> str:
    return f"{record.scene} {record.target} {start}"


def _search(record: Record, bank: Path, start: str | None) -> tuple[str, str]:
    scene = SceneBank.open(bank).scene(record.scene)
    return _key(record, start), path_in_truth(scene, record.target, record.seed, start=start or "upright")


if __name__ == "__main__":
    main()
