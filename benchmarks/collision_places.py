"""Where an agent collides in true rows, and what its scan knew of the place.

python benchmarks/collision_places.py --agent watchful --margin 0.02 --episodes 500

Plays episodes of the validation rows (``physics="truth"``, seeds 20000 on, as the trainings' validation has them), then
those that ended in a collision with a plant once more, and looks at the place between the parts that touched: how far
the nearest shape of the scan is, and whether the scan saw a surface, empty space or nothing there. A surface that was
seen, with a shape near by, is the rim of a leaf or the like, against which a margin helps; what was seen as surface or
empty far from all shapes is missing among the shapes; for the unseen only another look helps.
Writes results/collision_places.json, an entry per agent; those of others that it holds stay.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from imitation import FIRST_SEED
from policies import rates
from results_file import RESULTS, write_results

from greenhouse_gym.agents import PlannerAgent, WatchfulAgent
from greenhouse_gym.agents.agent import Agent
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.evaluation import Trace, evaluate, retrace
from greenhouse_gym.geometry import Array, distance_to_shapes
from greenhouse_gym.parallel import processes
from greenhouse_gym.scene import Scene, SceneBank, compile_scene
from greenhouse_gym.scene.seen import EMPTY, SURFACE, UNSEEN
from greenhouse_gym.scene.truth import true_scene

EDGES = (0.01, 0.02, 0.03, 0.05)
"""Distances from the scan's shapes by which places are counted, metres."""

STATES = {UNSEEN: "unseen", EMPTY: "empty", SURFACE: "surface"}


def main() -> None:
    """Play, look, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agent", default="watchful")
    parser.add_argument("--margin", type=float, help="that a planner or watchful keeps from boxes, metres")
    parser.add_argument("--bank", default="default")
    parser.add_argument("--split", default="validation")
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--seed", type=int, default=FIRST_SEED)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=RESULTS / "collision_places.json")
    a = parser.parse_args()
    bank = SceneBank.open(a.bank)
    where = {"split": a.split, "bank": bank.path, "physics": "truth"}
    name = a.agent if a.margin is None else f"{a.agent}, margin {100 * a.margin:g} cm"
    with processes(a.workers) as executor:
        evaluation = evaluate(agent_of(a.agent, a.margin), episodes=a.episodes, seed=a.seed, executor=executor, **where)
    seeds = [record.seed for record in evaluation.records if record.collision]
    traces = retrace(agent_of(a.agent, a.margin), seeds, **where) if seeds else ()
    counts: Counter[str] = Counter()
    for trace in traces:
        scene = bank.scene(trace.record.scene)
        counts[seen_there(scene, place_of(scene, trace))] += 1
    about = {"bank_sha256": bank.sha256, "split": a.split, "first_seed": a.seed}
    figures = about | rates(evaluation, bank) | {"collisions": dict(counts.most_common())}
    print(name, json.dumps(figures, indent=1))
    kept: dict[str, Any] = json.loads(a.out.read_text())["agents"] if a.out.is_file() else {}
    write_results(a.out, {"agents": kept | {name: figures}}, ["mujoco"])


def agent_of(name: str, margin: float | None) -> Agent:
    """The agent of a name, with a margin where one is given, metres."""
    if margin is None:
        return make_agent(name)
    return WatchfulAgent(margin) if name == WatchfulAgent.name else PlannerAgent(name, margin=margin)


def place_of(scene: Scene, trace: Trace) -> Array | None:
    """(3,) the middle between the parts that touched at an episode's end, metres; None where no plant was touched."""
    compiled = compile_scene(true_scene(scene), trace.robot)
    model, data = compiled.model, mujoco.MjData(compiled.model)
    data.qpos[:] = trace.joints[-1]
    mujoco.mj_kinematics(model, data)
    arm, plant = (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in trace.record.contact)
    if plant not in range(compiled.obstacle_geoms.start, compiled.obstacle_geoms.stop):
        return None
    ends = np.zeros(6)
    mujoco.mj_geomDistance(model, data, arm, plant, 1.0, ends)
    return np.asarray(ends.reshape(2, 3).mean(axis=0))


def seen_there(scene: Scene, place: Array | None) -> str:
    """What the scan knew of a place (3,): the nearest of its shapes, and what it saw there."""
    if place is None:
        return "no plant"
    away = float(distance_to_shapes(place[None], scene.obstacles).min(initial=np.inf))
    up_to = next((edge for edge in EDGES if away < edge), np.inf)
    state = "unsaid" if scene.seen is None else STATES[int(scene.seen.at(place[None])[0])]
    return f"{state}, shape within {100 * up_to:g} cm" if np.isfinite(up_to) else f"{state}, no shape within 5 cm"


if __name__ == "__main__":
    main()
