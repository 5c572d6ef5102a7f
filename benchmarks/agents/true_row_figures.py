"""Figures of `true_rows.py`: rates, what was touched, what a planner with the truth finds, what the scan knew."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from benchmarks.agents.policies import grouped, outcomes
from benchmarks.common import rate
from greenhouse_gym.evaluation import Trace
from greenhouse_gym.evaluation.records import Record
from greenhouse_gym.geometry import Array, distance_to_shapes
from greenhouse_gym.planning import plan
from greenhouse_gym.scene import Scene, compile_scene
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN
from greenhouse_gym.scene.truth import true_scene

SAME_TOMATO = 0.03
"""Maximum distance between a reconstructed tomato and the true one that it stands for, m."""
CHECKS, ATTEMPTS = 100_000, 2
"""Collision checks and seeds of the search with the truth known."""
EDGES = (0.01, 0.02, 0.03, 0.05)
"""Distances from the scan's shapes by which contact points are counted, m."""
STATES = {UNKNOWN: "unknown", FREE: "free", OCCUPIED: "occupied"}


def summary(records: Sequence[Record], kinds: Mapping[str, str]) -> dict[str, Any]:
    """Return the rates over all episodes and by kind of row, and what was touched by what."""
    rows = grouped(records, [kinds[record.scene] for record in records])
    collided = [record for record in records if record.collision]
    return {
        **_with_plans(records),
        "by_rows": {name: _with_plans(group) for name, group in rows.items()},
        "touched": dict(Counter(_plant_part(record) for record in collided).most_common()),
        "touched_by": dict(Counter(record.contact[0] for record in collided).most_common()),
    }


def _with_plans(records: Sequence[Record]) -> dict[str, Any]:
    """Return the outcomes, and for planners the fraction of episodes with a plan and the outcomes of these."""
    found = outcomes(records)
    if not any(record.status for record in records):
        return found
    planned = [record for record in records if record.status == "solved"]
    found["planned"] = rate(len(planned), len(records))
    found["of_planned"] = outcomes(planned)
    found["statuses"] = dict(Counter(record.status for record in records).most_common())
    return found


def _plant_part(record: Record) -> str:
    part = next((name for name in record.contact if name.startswith(("tomato_", "stem_", "clutter_"))), None)
    if part is None:
        return "-".join(sorted(record.contact))
    return {"tomato": "fruit", "clutter": "leaf"}.get(part.split("_")[0]) or part.split("_")[2]


def by_search(records: Sequence[Record], statuses: Sequence[str]) -> dict[str, Any]:
    """Return the outcomes and the number of scenes by the status of the search in the truth."""
    groups = grouped(records, statuses)
    return {s: outcomes(group) | {"scenes": len({r.scene for r in group})} for s, group in groups.items()}


def path_in_truth(
    scene: Scene, target: int, seed: int, checks: int = CHECKS, attempts: int = ATTEMPTS, start: str | None = None
) -> str:
    """Return the status of the search for a path to a tomato among the true shapes; "solved" if one was found."""
    true = true_scene(scene)
    gaps = np.linalg.norm(np.array([tomato.center for tomato in true.tomatoes]) - scene.tomatoes[target].center, axis=1)
    if gaps.min() > SAME_TOMATO:
        return "false tomato"
    status = ""
    for attempt in range(attempts):
        found = plan(true, int(gaps.argmin()), time_limit=None, max_checks=checks, seed=seed + attempt, start=start)
        status = found.status
        if status == "solved":
            break
    return status


# -- contact points ---------------------------------------------------------------------------------------------------


def contact_point(scene: Scene, trace: Trace) -> Array | None:
    """Return the midpoint (3,) between the parts that touched at an episode's end, m; None if it was no plant."""
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


def scan_state(scene: Scene, trace: Trace) -> str:
    """Return what the scan knew of an episode's contact point: the occupancy grid's state and the nearest shape."""
    point = contact_point(scene, trace)
    return "no plant" if point is None else state_at(scene, point)


def state_at(scene: Scene, point: Array) -> str:
    """Return what the scan knew of a point (3,), as `scan_state` does."""
    away = float(distance_to_shapes(point[None], scene.obstacles).min(initial=np.inf))
    edge = next((edge for edge in EDGES if away < edge), None)
    state = "no occupancy grid" if scene.occupancy is None else STATES[int(scene.occupancy.states_at(point[None])[0])]
    near = f"no shape within {100 * EDGES[-1]:g} cm" if edge is None else f"shape within {100 * edge:g} cm"
    return f"{state}, {near}"
