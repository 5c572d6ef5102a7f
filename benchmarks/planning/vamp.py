"""Compare the compiled RRTConnect with that of VAMP on exported problems: same arm, scenes, starts and goals.

python -m benchmarks.planning.vamp --python VENV/bin/python

VENV has VAMP with the arm of `benchmarks.planning.vamp_arm` as one of its robots. Problems are those of
`greenhouse_gym.export.problems.vamp`, with the floor and the cart. Both sides search, and shorten their path; times are
processor time without the preparation of a scene. VAMP sees the arm up to `EXCESS` thicker, so its obstacles grow by
that much less than the margin of planning. Takes 6 minutes.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from benchmarks.common import RESULTS, parser, rate, write_results
from benchmarks.planning.vamp_arm import EXCESS
from greenhouse_gym.export.primitives import Primitive, roll_pitch_yaw
from greenhouse_gym.export.problems import vamp
from greenhouse_gym.geometry import Array, invert, pose
from greenhouse_gym.motion.collision import MARGIN, PROOF, CollisionChecker, planning_model
from greenhouse_gym.motion.kernel_checker import KernelChecker
from greenhouse_gym.motion.path import path_length
from greenhouse_gym.motion.proof import ProvingChecker, checker_of
from greenhouse_gym.planning.connect import rrt_connect
from greenhouse_gym.planning.worker import PlannerQuery
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import DIFFICULTIES, CompiledScene, SceneBank, compile_scene
from greenhouse_gym.scene.mjcf import arm_pose

RANGES = {"own": 0.8, "VAMP": 1.5}
"""Longest motions by which trees grow, radians: both sides' defaults, VAMP's for its UR5."""

SECONDS = 20.0
"""Limit of our search; VAMP gets 5 million iterations, few with a check."""


class Problem(NamedTuple):
    """A problem with what judges its paths."""

    data: dict[str, Any]
    checker: ProvingChecker
    contacts: CollisionChecker


def main() -> None:
    """Plan on both sides and write the figures."""
    command = parser(__doc__)
    command.add_argument("--python", required=True, help="interpreter that has VAMP")
    command.add_argument("--split", default="validation")
    command.add_argument("--targets", type=int, default=200, help="most problems of each difficulty")
    command.add_argument("--out", type=Path, default=RESULTS / "vamp.json")
    a = command.parse_args()
    problems = list(_problems(a.split, a.targets))
    _own(problems[0])  # compiles the kernels
    own = [_own(problem) for problem in problems]
    theirs = _of_vamp(a.python, problems, own)
    figures = {"problems": len(problems), "split": a.split, "obstacles": _mean_obstacles(problems)}
    for group in ("all", *DIFFICULTIES[:3]):
        chosen = [k for k, each in enumerate(problems) if group in ("all", each.data["difficulty"])]
        figures[group] = {
            name: _summary([answers[k] for k in chosen], [problems[k] for k in chosen])
            for name, answers in (("own", own), ("VAMP", theirs))
        }
        for name, found in figures[group].items():
            print(group, name, found, flush=True)
    shown = [answer["given path is free"] for answer in theirs if answer["given path is free"] is not None]
    figures["own paths that VAMP finds free"] = rate(sum(shown), len(shown))
    figures["problems whose start or goals VAMP does not find free"] = sum("s" not in answer for answer in theirs)
    print({name: value for name, value in figures.items() if name not in ("all", *DIFFICULTIES)})
    write_results(a.out, figures)


def _problems(split: str, count: int) -> Iterator[Problem]:
    """Yield problems of each of three difficulties."""
    bank, arm = SceneBank.open("default"), get_robot("ur5e")
    left = dict.fromkeys(DIFFICULTIES[:3], count)
    for name in np.random.default_rng(0).permutation(bank.names(split)):
        scene = bank.scene(str(name))
        if not any(left[difficulty] and bank.difficulties(str(name)).get(difficulty) for difficulty in left):
            continue
        compiled = compile_scene(scene, arm)
        fixture = [_box(part) for part in _fixture(compiled)]
        for data in json.loads(vamp(scene, arm))["problems"][scene.name]:
            difficulty = data["difficulty"]
            if not (data["valid"] and left.get(difficulty)):
                continue
            target = int(data["name"].rpartition("-")[2])
            checker = checker_of(compiled, target)
            data["goals"] = [goal for goal in data["goals"] if checker.is_free(goal)]
            if not (data["goals"] and checker.is_free(data["start"])):
                continue
            left[difficulty] -= 1
            data["box"] = data["box"] + fixture
            yield Problem(data, checker, CollisionChecker(planning_model(compiled, target, 0.0), checker.reaches))


def _fixture(compiled: CompiledScene) -> Iterator[Primitive]:
    """Yield the floor and the cart in the frame of the arm's base."""
    model, base_from_scene = compiled.model, invert(arm_pose(compiled.scene, compiled.robot))
    solid = (model.geom_bodyid == 0) & (model.geom_contype > 0)
    solid[compiled.obstacle_geoms] = False
    for geom in np.flatnonzero(solid).tolist():
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        frame, size = pose(turn.reshape(3, 3), model.geom_pos[geom]), model.geom_size[geom].copy()
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            frame, size = frame @ pose(translation=[0.0, 0.0, -0.1]), np.array([5.0, 5.0, 0.1])
        elif model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_BOX:
            raise TypeError(f"{compiled.geom_name(geom)} is no box")
        yield Primitive(compiled.geom_name(geom), "box", tuple(size), base_from_scene @ frame, (0.5, 0.5, 0.5))


def _box(part: Primitive) -> dict[str, Any]:
    return {
        "name": part.name,
        "position": part.position.tolist(),
        "orientation_euler_xyz": roll_pitch_yaw(part.pose).tolist(),
        "half_extents": list(part.size),
    }


def _own(problem: Problem) -> dict[str, Any]:
    """Plan by the compiled RRTConnect."""
    checker, arm = problem.checker, get_robot("ur5e")
    query = PlannerQuery(
        model=checker.model, reaches=checker.reaches, lower=arm.lower, upper=arm.upper,
        start=np.array(problem.data["start"]), goals=np.array(problem.data["goals"]), planner="RRTConnect",
        settings={"range": RANGES["own"]}, time_limit=SECONDS, max_checks=None, optimizing=False, seed=0,
    )  # fmt: skip
    search = checker.search
    assert isinstance(search, KernelChecker)
    began = time.process_time()
    answer = rrt_connect(query, search)
    return {"s": time.process_time() - began, "path": None if answer.path is None else answer.path.tolist()}


def _of_vamp(python: str, problems: Sequence[Problem], own: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Plan by VAMP, which also checks our paths."""
    queries = [
        {
            "start": problem.data["start"],
            "goals": problem.data["goals"],
            "range": RANGES["VAMP"],
            "plain": problem.data,
            "grown": _grown(problem.data, MARGIN - EXCESS),
            "path": answer["path"],
        }
        for problem, answer in zip(problems, own, strict=True)
    ]
    with tempfile.TemporaryDirectory() as folder:
        given, returned = Path(folder) / "problems.json", Path(folder) / "answers.json"
        given.write_text(json.dumps({"robot": "ur5e", "problems": queries}))
        script = Path(__file__).with_name("vamp_side.py")
        subprocess.run([python, "-I", script, given, returned], check=True, stdout=subprocess.DEVNULL)
        answers: list[dict[str, Any]] = json.loads(returned.read_text())
    return answers


def _grown(data: dict[str, Any], margin: float) -> dict[str, Any]:
    """Return a problem with larger obstacles."""
    boxes = [box | {"half_extents": [half + margin for half in box["half_extents"]]} for box in data["box"]]
    round_ones = {
        kind: [each | {"radius": each["radius"] + margin} for each in data[kind]] for kind in ("sphere", "cylinder")
    }
    return data | round_ones | {"box": boxes}


def _summary(answers: Sequence[dict[str, Any]], problems: Sequence[Problem]) -> dict[str, Any]:
    """Return rates and times of one side."""
    found = [(problem, _ends_of(problem, answer)) for problem, answer in zip(problems, answers, strict=True)]
    paths = [(problem, path) for problem, path in found if path is not None]
    milliseconds = np.array([1000 * answer["s"] for answer in answers if "s" in answer])
    return {
        "solved": rate(len(paths), len(problems)),
        "proven": rate(sum(problem.checker.path_is_free(path, PROOF) for problem, path in paths), len(problems)),
        "without contact": rate(
            sum(problem.contacts.path_is_free(path, PROOF) for problem, path in paths), len(problems)
        ),
        "mean ms": round(float(milliseconds.mean()), 2),
        "median ms": round(float(np.median(milliseconds)), 2),
        "95th percentile ms": round(float(np.percentile(milliseconds, 95)), 2),
        "mean path rad": round(float(np.mean([path_length(path) for _, path in paths])), 2),
    }


def _ends_of(problem: Problem, answer: dict[str, Any]) -> Array | None:
    """Return a path with its ends in double precision; VAMP computes in single."""
    if answer["path"] is None:
        return None
    path, goals = np.array(answer["path"]), np.array(problem.data["goals"])
    path[0], path[-1] = problem.data["start"], goals[np.abs(goals - path[-1]).max(axis=1).argmin()]
    return path


def _mean_obstacles(problems: Sequence[Problem]) -> float:
    kinds = ("sphere", "cylinder", "box")
    return float(np.mean([sum(len(problem.data[kind]) for kind in kinds) for problem in problems]))


if __name__ == "__main__":
    main()
