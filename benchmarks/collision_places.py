"""Where an agent collides in true rows, and what its scan knew of the place.

python benchmarks/collision_places.py --agent watchful --margin 0.02 --episodes 500
python benchmarks/collision_places.py --agent watchful --noise --noisy --episodes 150
python benchmarks/collision_places.py --agent RRTConnect --unknown avoid --split train --seed 50000 --episodes 250

Plays episodes of the validation rows (``physics="truth"``, seeds 20000 on, as the trainings' validation has them), then
those that ended in a collision with a plant once more, and looks at the place between the parts that touched: how far
the nearest shape of the scan is, and whether the scan saw a surface, empty space or nothing there. A surface that was
seen, with a shape near by, is the rim of a leaf or the like, against which a margin helps; what was seen as surface or
empty far from all shapes is missing among the shapes; for the unknown only another look helps.
Writes results/collision_places.json, an entry per agent; those of others that it holds stay. On two cores, 500 episodes
take an hour with `watchful`, and five minutes with RRTConnect.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Mapping
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
from greenhouse_gym.common.executors import processes
from greenhouse_gym.envs import Randomization
from greenhouse_gym.evaluation import Trace, evaluate, retrace
from greenhouse_gym.geometry import Array, distance_to_shapes
from greenhouse_gym.motion.unknown_space import UNKNOWN_RULES
from greenhouse_gym.scene import Scene, SceneBank, compile_scene
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN
from greenhouse_gym.scene.truth import true_scene

EDGES = (0.01, 0.02, 0.03, 0.05)
"""Distances from the scan's shapes by which places are counted, metres."""

STATES = {UNKNOWN: "unknown", FREE: "empty", OCCUPIED: "surface"}


def main() -> None:
    """Play, look, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agent", default="watchful")
    parser.add_argument("--margin", type=float, help="that a planner or watchful keeps from boxes, metres")
    parser.add_argument("--unknown", type=depth_or_rule, help="what unknown space is to a planner: a rule, or a depth")
    parser.add_argument("--unexplained", action=argparse.BooleanOptionalAction, help="heed surfaces without a shape")
    parser.add_argument("--depth", type=float, help="how deep watchful goes into unknown space at first, metres")
    parser.add_argument("--image", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="of watchful's camera, pixels")
    parser.add_argument("--noise", action="store_true", help="noise of a D435 in the images of the arm's camera")
    parser.add_argument("--noisy", action=argparse.BooleanOptionalAction, help="watchful reads its images as such")
    parser.add_argument("--bank", default="default")
    parser.add_argument("--split", default="validation")
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--seed", type=int, default=FIRST_SEED)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=RESULTS / "collision_places.json")
    a = parser.parse_args()
    bank = SceneBank.open(a.bank)
    where: dict[str, Any] = {"split": a.split, "bank": bank.path, "physics": "truth"}
    if a.noise:
        where["randomization"] = Randomization(depth_noise=True)
    asked = {
        "margin": a.margin, "unknown": a.unknown, "unexplained": a.unexplained, "depth": a.depth, "image": a.image,
        "noisy": a.noisy,
    }  # fmt: skip
    options = {key: value for key, value in asked.items() if value is not None}
    told_options = [told(key, value) for key, value in options.items()] + ["noise"] * a.noise
    name = ", ".join([a.agent, *told_options, f"{a.split} rows"])
    agent = agent_of(a.agent, options)
    with processes(a.workers) as executor:
        evaluation = evaluate(agent, episodes=a.episodes, seed=a.seed, executor=executor, **where)
    seeds = [record.seed for record in evaluation.records if record.collision]
    traces = retrace(agent, seeds, **where) if seeds else ()
    counts: Counter[str] = Counter()
    for trace in traces:
        scene = bank.scene(trace.record.scene)
        counts[seen_there(scene, place_of(scene, trace))] += 1
    about = {"bank_sha256": bank.sha256, "split": a.split, "first_seed": a.seed}
    figures = about | rates(evaluation, bank) | {"collisions": dict(counts.most_common())}
    print(name, json.dumps(figures, indent=1))
    kept: dict[str, Any] = json.loads(a.out.read_text())["agents"] if a.out.is_file() else {}
    write_results(a.out, {"agents": kept | {name: figures}}, ["mujoco"])


def told(option: str, value: str | float | bool | list[int]) -> str:
    """An option in an entry's name."""
    if isinstance(value, bool):
        return option if value else f"no {option}"
    return f"{option} {' x '.join(map(str, value))}" if isinstance(value, list) else f"{option} {value}"


def depth_or_rule(text: str) -> str | float:
    """What `greenhouse_gym.planning.plan` takes for ``unknown``."""
    return text if text in UNKNOWN_RULES else float(text)


def agent_of(name: str, options: Mapping[str, Any]) -> Agent:
    """The agent of a name; with options, it must be `watchful` or a planner."""
    if not options:
        return make_agent(name)
    return WatchfulAgent(**options) if name == WatchfulAgent.name else PlannerAgent(name, **options)


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
    up_to = next((edge for edge in EDGES if away < edge), None)
    state = "unsaid" if scene.occupancy is None else STATES[int(scene.occupancy.states_at(place[None])[0])]
    near = f"no shape within {100 * EDGES[-1]:g} cm" if up_to is None else f"shape within {100 * up_to:g} cm"
    return f"{state}, {near}"


if __name__ == "__main__":
    main()
