"""Plan with VAMP; `benchmarks.planning.vamp` runs this file by the interpreter that has it, without this package."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

ITERATIONS, SAMPLES = 5_000_000, 100_000


def solved(name: str, problem: dict[str, Any]) -> dict[str, Any]:
    """Plan and shorten a path, and check a given one between the obstacles as they are; seconds are processor time."""
    import vamp  # type: ignore[import-not-found]

    robot, planner, settings, simplification = vamp.configure_robot_and_planner_with_kwargs(
        name, "rrtc", range=problem["range"], max_iterations=ITERATIONS, max_samples=SAMPLES
    )
    scene, plain = (vamp.problem_dict_to_vamp(problem[obstacles]) for obstacles in ("grown", "plain"))
    rng = robot.halton()
    goals = [goal for goal in problem["goals"] if robot.validate(goal, scene)]
    result: dict[str, Any] = {
        "start is free": robot.validate(problem["start"], scene),
        "free goals": len(goals),
        "given path is free": None if problem["path"] is None else _path(robot, problem["path"]).validate(plain),
        "path": None,
    }
    if not (goals and result["start is free"]):
        return result
    began = time.process_time()
    found = planner(problem["start"], goals, scene, settings, rng)
    result["search s"] = result["s"] = time.process_time() - began
    if found.solved:
        path = robot.simplify(found.path, scene, simplification, rng).path
        result["s"] = time.process_time() - began
        result["path"] = path.numpy().tolist()
    return result


def _path(robot: Any, points: list[list[float]]) -> Any:
    path = robot.Path()
    for point in points:
        path.append(point)
    return path


if __name__ == "__main__":
    with open(sys.argv[1]) as file:  # noqa: PTH123
        data = json.load(file)
    answers = [solved(data["robot"], problem) for problem in data["problems"]]
    with open(sys.argv[2], "w") as file:  # noqa: PTH123
        json.dump(answers, file)
