"""How agents do in the true rows of `capture_protocols.py`, of which they are told the scan.

python benchmarks/protocol_agents.py --agents watchful careful --source helios --rows 811-820 --workdir WORKDIR

Takes the scenes that `capture_protocols.py` made with the same options under the same workdir, draws some of the
tomatoes within reach in each, whether any planner finds a way to them or not, and has each agent play one episode with
each (``physics="truth"``). Episodes are kept under the workdir as they are finished, so an interrupted run goes on
where it stopped.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from capture_protocols import ENDS, protocol_and_start, room_for, row_numbers, targets_of
from capture_protocols_rows import SCENES, Options, folder_of, scenes_in
from results_file import RESULTS, write_results

from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.kept_records import KeptRecords
from greenhouse_gym.records import Record, wilson_interval
from greenhouse_gym.scene import Scene, Target
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
    for agent in a.agents:
        records = [record for row in rows for record in played(agent, row, protocol, start, options)]
        figures[agent] = rates(records)
        print(agent, figures[agent], flush=True)
        about = {"source": a.source, "protocol": protocol, "start": start, "rows": rows, "per_scene": a.per_scene}
        write_results(a.out, about | {"leaves": a.leaves, "agents": figures}, ["mujoco", "ompl"])


def played(agent: str, row: int, protocol: str, start: str, options: Options) -> Sequence[Record]:
    """The episodes of an agent in a row, played unless they are kept."""
    folder = folder_of(row, protocol, options)
    ends = round(ENDS / options.spacing)
    scenes = scenes_in(folder)[ends:-ends]
    problems = [(scene.name, k) for scene in scenes for k in targets_of(scene, row, options)[0]]
    with tempfile.TemporaryDirectory() as bank:
        write_bank(bank, [(with_targets(scene), "test") for scene in scenes], "rows")
        kept = KeptRecords(
            folder / f"{agent}-{start}-{options.per_scene}.jsonl", {"agent": agent, "problems": problems}
        )
        result = evaluate(
            make_agent(agent),
            bank=bank,
            problems=problems,
            physics="truth",
            capacity=room_for(scenes),
            start=start,
            kept=kept,
        )
    return result.records


def with_targets(scene: Scene) -> Scene:
    """A scene of which every tomato may be a target; nobody rated how hard they are."""
    targets = tuple(Target(tomato=k, difficulty="easy") for k in range(len(scene.tomatoes)))
    return scene.model_copy(update={"targets": targets})


def rates(records: Sequence[Record]) -> dict[str, Any]:
    """How many reached and collided, with 95 % intervals."""
    count = len(records)
    result: dict[str, Any] = {"episodes": count}
    for name in ("success", "collision"):
        hits = sum(bool(getattr(record, name)) for record in records)
        result[name] = round(hits / max(count, 1), 4)
        result[f"{name}_95"] = np.round(wilson_interval(hits, count), 4).tolist()
    return result


if __name__ == "__main__":
    main()
