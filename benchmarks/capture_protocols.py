"""How must a row be photographed so that plans made on the scan hold in the plants?

    python benchmarks/capture_protocols.py --rows 711-716                       # development rows
    python benchmarks/capture_protocols.py --rows 801-810 --out benchmarks/results/capture_protocols.json

Every row is photographed by every protocol, reconstructed and cut into scenes. In each scene every tomato within reach
is planned for on the reconstruction, and the path is followed in the true row (``physics="truth"``): the arm reaches
the tomato, or hits something, or there was no plan to follow. Scenes and episodes are kept under --workdir as they are
finished, so an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from capture_protocols_rows import Options, folder_of, scenes_of
from capture_protocols_summary import summaries, table
from results_file import write_results

from greenhouse_gym import ENV_IDS
from greenhouse_gym.agents import Problem
from greenhouse_gym.agents.planner_agent import PathFollower
from greenhouse_gym.capture import PROTOCOLS, get_protocol
from greenhouse_gym.common.executors import completed, executor_for
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.envs import PlantMotion, Randomization
from greenhouse_gym.envs.environment import GreenhouseEnv
from greenhouse_gym.motion.unknown_space import UNSEEN_RULES
from greenhouse_gym.planning import PlanResult, plan
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.occupancy import EMPTY, SURFACE, UNSEEN

REACH = 0.95
"""Metres from the shoulder up to which a tomato is a target."""

ENDS = 0.25
"""Metres by which stands keep farther from the walk's ends than half a spacing: nothing was scanned beyond."""

STATES = {UNSEEN: "unseen", EMPTY: "empty", SURFACE: "at a surface"}

SAME = 0.03
"""Metres between the centers of a reconstructed tomato and of the true one it stands for."""


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--rows", type=row_numbers, default=row_numbers("711-716"), help="seeds, such as 711-716 or 711,713"
    )
    parser.add_argument("--source", default="own", help="own or helios")
    parser.add_argument(
        "--protocols", nargs="+", default=list(PROTOCOLS), metavar="NAME[:START]",
        help="names, each with what the arm starts from: start (upright, if left out) or folded",
    )  # fmt: skip
    parser.add_argument("--unseen", nargs="+", default=["free"], metavar="RULE", help="free, avoid, forbid, or a depth")
    parser.add_argument("--length", type=float, default=2.0, help="of a row, metres")
    parser.add_argument("--spacing", type=float, default=0.5, help="between the stands of the arm, metres")
    parser.add_argument("--robot", default="ur5e")
    parser.add_argument("--planner", default="RRTConnect")
    parser.add_argument("--checks", type=int, default=20_000, help="collision checks of a plan")
    parser.add_argument("--primitives", type=int, default=600, help="most shapes in a scene")
    parser.add_argument("--fine", action="store_true", help="have bent leaves become many small boxes")
    parser.add_argument("--leaves", type=float, default=0.02, help="how far off its leaves the truth may lie, metres")
    parser.add_argument("--margin", type=float, default=0.0, help="how far paths keep from boxes of leaves, metres")
    parser.add_argument("--surfaces", action="store_true", help="keep out of seen surfaces that have no shape")
    parser.add_argument("--per-scene", type=int, default=20, help="most targets of a scene")
    parser.add_argument("--moved", action="store_true", help="follow in plants that moved since they were scanned")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--workdir", type=Path, default=Path("capture_protocols"))
    parser.add_argument("--only-finished", action="store_true", help="measure nothing, tell what is there")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    a = parser.parse_args()
    options = Options(
        a.source,
        a.length,
        a.spacing,
        a.robot,
        a.planner,
        a.checks,
        a.primitives,
        a.fine,
        a.per_scene,
        a.moved,
        a.leaves,
        a.margin,
        a.surfaces,
        a.workdir,
    )
    tasks = [(row, *protocol_and_start(name), unseen) for row, name, unseen in product(a.rows, a.protocols, a.unseen)]
    if a.only_finished:
        tasks = [task for task in tasks if _episodes_file(*task, options).exists()]
    episodes: list[dict[str, Any]] = []
    with executor_for("processes" if a.workers > 1 else "serial", a.workers) as executor:
        for part in completed(partial(measure, options=options), tasks, executor):
            episodes += part
            print(f"\n{table(summaries(episodes))}", flush=True)
    if a.out:
        command = (
            f"benchmarks/capture_protocols.py --source {a.source} --rows {','.join(map(str, a.rows))} "
            f"--protocols {' '.join(a.protocols)} --unseen {' '.join(a.unseen)} --length {a.length:g} "
            f"--spacing {a.spacing:g} --primitives {a.primitives}{' --fine' * a.fine} --planner {a.planner} "
            f"--checks {a.checks} --leaves {a.leaves:g} --margin {a.margin:g} --per-scene {a.per_scene}"
            f"{' --surfaces' * a.surfaces}{' --moved' * a.moved}{' --only-finished' * a.only_finished}"
        )
        rows = sorted({task[0] for task in tasks})
        figures = {"command": command, "source": a.source, "rows_measured": rows, "figures": summaries(episodes)}
        write_results(a.out, figures, ["mujoco", "ompl", "open3d"])


def row_numbers(text: str) -> list[int]:
    """Seeds of rows, such as 711-716 or 711,713."""
    first, _, last = text.partition("-")
    return list(range(int(first), int(last) + 1)) if last else [int(part) for part in text.split(",")]


def protocol_and_start(text: str) -> tuple[str, str]:
    """A protocol's name and what the arm starts from, such as upright-back:folded."""
    protocol, _, start = text.partition(":")
    return get_protocol(protocol).name, start or "start"


_Task = tuple[int, str, str, str]  # row, protocol, start, unseen


def measure(task: _Task, options: Options) -> list[dict[str, Any]]:
    """All episodes of one row photographed by one protocol."""
    seed, protocol, start, unseen = task
    file = _episodes_file(seed, protocol, start, unseen, options)
    if not file.exists():
        scenes = scenes_of(seed, protocol, options)
        ends = round(ENDS / options.spacing)
        scenes = scenes[ends : len(scenes) - ends]
        about = {"source": options.source, "row": seed, "protocol": protocol, "unseen": unseen, "start": start}
        found = reach_in(scenes, unseen, start, seed, options)
        write_atomically(file, json.dumps([about | episode for episode in found]))
    return episodes_of(seed, protocol, start, unseen, options)


def reach_in(scenes: Sequence[Scene], unseen: str, start: str, seed: int, options: Options) -> list[dict[str, Any]]:
    """All episodes of some scenes."""
    env = gymnasium.make(
        ENV_IDS[0], bank="mini", robot=options.robot, physics="truth", capacity=room_for(scenes),
        randomization=Randomization(plants=PlantMotion() if options.moved else None),
    )  # fmt: skip
    found = [episode for scene in scenes for episode in reach_all(scene, env, unseen, start, seed, options)]
    env.close()
    return found


def _episodes_file(seed: int, protocol: str, start: str, unseen: str, options: Options) -> Path:
    care = f"-{options.margin:g}" * (options.margin > 0) + "-surfaces" * options.surfaces + "-moved" * options.moved
    name = f"{options.robot}-{options.planner}-{options.checks}-{options.per_scene}-{start}-{unseen}{care}.json"
    return folder_of(seed, protocol, options) / name


def episodes_of(seed: int, protocol: str, start: str, unseen: str, options: Options) -> list[dict[str, Any]]:
    """The episodes of a row, protocol and mode that were measured."""
    result: list[dict[str, Any]] = json.loads(_episodes_file(seed, protocol, start, unseen, options).read_text())
    return result


def room_for(scenes: Sequence[Scene]) -> int:
    """Obstacles the largest truth has, rounded up."""
    return 1000 * (1 + max(0 if scene.truth is None else len(scene.truth.obstacles) for scene in scenes) // 1000)


def targets_of(scene: Scene, seed: int, options: Options) -> tuple[list[int], float]:
    """Some of the tomatoes within reach of the arm, drawn by the row's seed, and their share of all of those."""
    shoulder = np.array([0.0, 0.0, scene.stand.shoulder_height])
    near = [k for k, t in enumerate(scene.tomatoes) if np.linalg.norm(t.center - shoulder) < REACH]
    drawn = np.random.default_rng(seed).permutation(near)[: options.per_scene].tolist()
    return drawn, len(drawn) / max(1, len(near))


def reach_all(
    scene: Scene, env: gymnasium.Env[Any, Any], unseen: str, start: str, seed: int, options: Options
) -> list[dict[str, Any]]:
    """Plan for the tomatoes within reach, and follow the paths in the truth."""
    assert scene.truth is not None
    shoulder = np.array([0.0, 0.0, scene.stand.shoulder_height])
    drawn, share = targets_of(scene, seed, options)
    true = np.array([tomato.center for tomato in scene.truth.tomatoes]).reshape(-1, 3)
    within = int(np.count_nonzero(np.linalg.norm(true - shoulder, axis=1) < REACH))
    seen = None if scene.seen is None else round(scene.seen.share(shoulder, REACH), 4)
    result = []
    for k in drawn:
        gaps = np.linalg.norm(true - scene.tomatoes[k].center, axis=1)
        match = int(gaps.argmin()) if gaps.min(initial=np.inf) < SAME else None
        about = {
            "scene": scene.name, "target": k, "match": match, "true_within_reach": within * share,
            "place": scene.tomatoes[k].center.round(3).tolist(), "seen": seen,
        }  # fmt: skip
        result.append(about | reach(scene, k, env, unseen, start, options))
    return result


def plan_of(scene: Scene, target: int, unseen: str, start: str, options: Options) -> PlanResult:
    """The plan of an episode; the checks and not the clock end its search."""
    return plan(
        scene, target, options.robot, options.planner, time_limit=120.0, max_checks=options.checks, start=start,
        unseen=unseen if unseen in UNSEEN_RULES else float(unseen), margin=options.margin,
        surfaces=options.surfaces,
    )  # fmt: skip


def reach(
    scene: Scene, target: int, env: gymnasium.Env[Any, Any], unseen: str, start: str, options: Options
) -> dict[str, Any]:
    """One episode: a plan on the reconstruction, followed in the truth."""
    reaching = env.unwrapped
    assert isinstance(reaching, GreenhouseEnv)
    planned = plan_of(scene, target, unseen, start, options)
    if planned.path is None:
        return {"status": planned.status, "outcome": "no plan"}
    env.reset(seed=target, options={"scene": scene, "target": target, "start": start})
    problem = Problem(scene, target, reaching.robot, reaching.start)
    follower = PathFollower(planned.path, problem, proven=True)
    for _ in range(len(follower.commands) + 20):
        _, _, terminated, truncated, info = env.step(follower.action())
        if terminated or truncated:
            break
    outcome = "reached" if info["is_success"] else "collided" if info["collision"] else "missed"
    episode = {
        "status": planned.status, "outcome": outcome, "distance": float(info["distance"]),
        "clearance": planned.clearance,
    }  # fmt: skip
    if outcome == "collided":
        episode |= {"contact": list(info["contact"])} | _touched(scene, *reaching.model_and_data(), info["contact"])
    return episode


def _touched(scene: Scene, model: mujoco.MjModel, data: mujoco.MjData, names: Sequence[str]) -> dict[str, Any]:
    """Where a plant was touched, metres, and what the scan says of that place."""
    touched = next((name for name in names if name.startswith(("tomato_", "stem_", "clutter_"))), None)
    if touched is None:
        return {"at": None}
    geom = model.geom(touched)
    places = [contact.pos.copy() for contact in data.contact[: data.ncon] if geom.id in contact.geom]
    place = places[0] if places else geom.pos
    space = None if scene.seen is None else STATES[int(scene.seen.at(place)[0])]
    return {"at": place.round(3).tolist(), "space": space}


if __name__ == "__main__":
    main()
