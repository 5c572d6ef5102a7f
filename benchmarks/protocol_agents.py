"""How agents do in the true rows of `capture_protocols.py`, of which they are told the scan.

python benchmarks/protocol_agents.py --agents watchful careful --source helios --rows 811-820 --workdir WORKDIR

Takes the scenes that `capture_protocols.py` made with the same options under the same workdir, but for those where the
arm would touch something at its start. It draws some of the tomatoes within reach in each, whether any planner finds a
way to them or not, and has each agent play one episode with each (``physics="truth"``). Since nobody rated these, rates
are told once more by how a planner fares with them that knows the true row, as in `truth_ceiling.py`. Episodes are kept
under the workdir as they are finished, so an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
from capture_protocols import ENDS, protocol_and_start, room_for, row_numbers, targets_of
from capture_protocols_rows import SCENES, Options, folder_of, scenes_in
from results_file import RESULTS, write_results
from truth_ceiling import path_in_truth

from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.common.executors import completed, processes
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.evaluation.journal import RecordJournal
from greenhouse_gym.evaluation.records import Record, wilson_interval
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, Target, compile_scene
from greenhouse_gym.scene.bank import write_bank


def main() -> None:
    """Play, print, write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", nargs="+", default=["watchful"])
    parser.add_argument("--source", default="helios", help="own or helios")
    parser.add_argument("--rows", type=row_numbers, default=row_numbers("811-820"))
    parser.add_argument("--protocol", default="upright-back", metavar="NAME[:START]")
    parser.add_argument("--length", type=float, default=1.5)
    parser.add_argument("--spacing", type=float, default=0.25)
    parser.add_argument("--primitives", type=int, default=600)
    parser.add_argument("--leaves", type=float, default=0.01)
    parser.add_argument("--per-scene", type=int, default=8, help="most targets of a scene")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--workdir", type=Path, default=Path("capture_protocols"))
    parser.add_argument("--out", type=Path, default=RESULTS / "protocol_agents.json")
    a = parser.parse_args()
    options = Options(
        a.source, a.length, a.spacing, primitives=a.primitives, per_scene=a.per_scene, leaves=a.leaves,
        workdir=a.workdir,
    )  # fmt: skip
    protocol, start = protocol_and_start(a.protocol)
    rows = [row for row in a.rows if (folder_of(row, protocol, options) / SCENES).exists()]
    figures: dict[str, Any] = {}
    with processes(a.workers) as executor:
        drawn = {row: drawn_in(row, protocol, start, options) for row in rows}
        searched = {row: searched_in_truth(row, drawn[row], protocol, start, options, executor) for row in rows}
        for agent in a.agents:
            ended: list[tuple[Record, str]] = []
            for row in rows:
                records = played(agent, row, drawn[row], protocol, start, options, executor)
                ended += zip(records, searched[row], strict=True)
                figures[agent] = rates([record for record, _ in ended]) | {"search in the truth": by_search(ended)}
                print(agent, row, figures[agent], flush=True)
            about = {"source": a.source, "protocol": protocol, "start": start, "rows": rows, "per_scene": a.per_scene}
            write_results(a.out, about | {"leaves": a.leaves, "agents": figures}, ["mujoco", "ompl"])


def drawn_in(row: int, protocol: str, start: str, options: Options) -> list[tuple[Scene, int]]:
    """Tomatoes of a row, each with its scene."""
    ends = round(ENDS / options.spacing)
    scenes = scenes_in(folder_of(row, protocol, options))[ends:-ends]
    usable = [scene for scene in scenes if start_is_collision_free(scene, options.robot, start)]
    return [(scene, k) for scene in usable for k in targets_of(scene, row, options)[0]]


def start_is_collision_free(scene: Scene, robot: str, start: str) -> bool:
    """Whether the arm touches no shape of the scan where it starts."""
    arm = get_robot(robot)
    checker = CollisionChecker(planning_model(compile_scene(scene, arm), target=0), arm_reaches(arm))
    return checker.is_free(arm.configuration(start))


def searched_in_truth(
    row: int, drawn: list[tuple[Scene, int]], protocol: str, start: str, options: Options, executor: Executor
) -> list[str]:
    """How a planner that knows the row fares with each of some tomatoes, see `path_in_truth`; looked for once."""
    file = folder_of(row, protocol, options) / f"truth-{start}-{options.per_scene}.json"
    if not file.exists():
        tasks = [(k, scene, target, start) for k, (scene, target) in enumerate(drawn)]
        found = dict(completed(_path, tasks, executor))
        write_atomically(file, json.dumps([found[k] for k in range(len(drawn))]))
    statuses: list[str] = json.loads(file.read_text())
    return statuses


def _path(task: tuple[int, Scene, int, str]) -> tuple[int, str]:
    number, scene, target, start = task
    return number, path_in_truth(scene, target, seed=target, start=start)


def played(
    agent: str,
    row: int,
    drawn: list[tuple[Scene, int]],
    protocol: str,
    start: str,
    options: Options,
    executor: Executor,
) -> Sequence[Record]:
    """The episodes of an agent in a row, played unless they are kept."""
    folder = folder_of(row, protocol, options)
    scenes = {scene.name: scene for scene, _ in drawn}
    problems = [(scene.name, k) for scene, k in drawn]
    with tempfile.TemporaryDirectory() as bank:
        write_bank(bank, [(with_targets(scene), "test") for scene in scenes.values()], "rows")
        kept = RecordJournal(
            folder / f"{agent}-{start}-{options.per_scene}.jsonl", {"agent": agent, "problems": problems}
        )
        result = evaluate(
            make_agent(agent),
            bank=bank,
            problems=problems,
            physics="truth",
            capacity=room_for(list(scenes.values())),
            start=start,
            journal=kept,
            executor=executor,
        )
    return result.records


def with_targets(scene: Scene) -> Scene:
    """A scene of which every tomato may be a target; nobody rated how hard they are."""
    targets = tuple(Target(tomato=k, difficulty="easy") for k in range(len(scene.tomatoes)))
    return scene.model_copy(update={"targets": targets})


def by_search(ended: list[tuple[Record, str]]) -> dict[str, Any]:
    """The rates, and from how many stands, by the status of the search in the truth; "solved" where there is a path."""
    result: dict[str, Any] = {}
    for status in sorted({status for _, status in ended}):
        records = [record for record, each in ended if each == status]
        result[status] = rates(records) | {"stands": len({record.scene for record in records})}
    return result


def rates(records: Sequence[Record]) -> dict[str, Any]:
    """How many reached, and how many collided, with 95 % intervals; the others gave up or were late."""
    count = len(records)
    result: dict[str, Any] = {"episodes": count}
    for name in ("success", "collision"):
        hits = sum(bool(getattr(record, name)) for record in records)
        result[name] = round(hits / max(count, 1), 4)
        result[f"{name}_95"] = np.round(wilson_interval(hits, count), 4).tolist()
    return result


if __name__ == "__main__":
    main()
