"""Measure the work that compiled kernels do: first use of scenes, collision checks, plans, images and planning agents.

python -m benchmarks.speed.kernels

Seconds are processor time, because other work may share the machine. ``--only`` chooses some of the measurements;
the results of the others stay. Takes 4 minutes. Run it in another checkout, with ``--out``, to compare versions.
"""

from __future__ import annotations

import os
import resource
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

from benchmarks.common import RESULTS, in_own_process, parser, processor_seconds, seconds_of, write_entry
from greenhouse_gym.agents import WatchfulAgent
from greenhouse_gym.envs.world import capacity_of
from greenhouse_gym.envs.worlds import Worlds
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.motion.collision import CollisionChecker
from greenhouse_gym.motion.proof import checker_of
from greenhouse_gym.planning import plan
from greenhouse_gym.rendering.cameras import MAX_RANGE, TIP_FROM_WRIST, DepthCamera
from greenhouse_gym.rendering.raycaster import RayCaster
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import DIFFICULTIES, Scene, SceneBank, compile_scene

CHECKS = 20_000  # after which a search for a path ends


def main() -> None:
    """Measure and write the results."""
    measures: dict[str, Callable[[], dict[str, Any]]] = {
        "first reset of 16": partial(in_own_process, first_reset, 16),
        "first reset of 256": partial(in_own_process, first_reset, 256),
        "compiling the kernels": compiled,
        "first use of a true row": partial(in_own_process, true_rows, 12),
        "collision check": partial(in_own_process, checks, 6),
        "plan": partial(in_own_process, plans, 30),
        "depth image of a true row": partial(in_own_process, depth_images, 3),
        "watchful in the truth": partial(in_own_process, watchful, 10),
    }
    command = parser(__doc__)
    command.add_argument("--only", nargs="*", choices=measures, default=list(measures))
    command.add_argument("--out", type=Path, default=RESULTS / "kernels.json")
    a = command.parse_args()
    for name in a.only:
        found = {key: round(value, 6) if isinstance(value, float) else value for key, value in measures[name]().items()}
        print(name, found, flush=True)
        write_entry(a.out, name, found)


def first_reset(count: int) -> dict[str, Any]:
    """Measure the first reset of a vector environment on the default bank, in a new process with compiled kernels."""
    import greenhouse_gym  # noqa: F401  (registers the environment)

    env = gymnasium.make_vec("TomatoReach-v0", num_envs=count)
    wall = time.perf_counter()
    seconds = seconds_of(lambda: env.reset(seed=0), time.process_time)
    wall = time.perf_counter() - wall
    gigabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {"processor s": seconds, "wall s": wall, "peak memory of the process GB": gigabytes}


def first_plan() -> dict[str, Any]:
    """Measure the first plan of a process."""
    bank = SceneBank.open("default")
    scene = bank.scene(bank.names("validation")[0])
    return {"processor s": seconds_of(lambda: plan(scene, 0, max_checks=CHECKS, time_limit=None), time.process_time)}


def compiled() -> dict[str, Any]:
    """Measure the first reset and step, and the first plan, each with an empty cache and with a full one."""
    found: dict[str, Any] = {}
    for name, measure in (("reset", partial(first_reset, 1)), ("plan", first_plan)):
        with tempfile.TemporaryDirectory() as folder:
            os.environ["NUMBA_CACHE_DIR"] = folder
            try:
                empty, full = (in_own_process(measure)["processor s"] for _ in range(2))
            finally:
                del os.environ["NUMBA_CACHE_DIR"]
        found |= {f"first {name} with an empty cache, processor s": empty, f"first {name} with a full one": full}
    return found


def true_rows(count: int) -> dict[str, Any]:
    """Measure the first use of scenes with the true row as physics."""
    bank = SceneBank.open("default")
    entries = [entry for entry in bank.manifest.scenes if entry.truth][:: len(bank) // count][: count + 1]
    scenes = [bank.scene(entry.name) for entry in entries]
    worlds = Worlds(get_robot("ur5e"), "truth", capacity_of(bank, "truth"))
    worlds.world(scenes[0])  # compiles what all share
    seconds = seconds_of(lambda: [worlds.world(scene) for scene in scenes[1:]], time.process_time)
    return {"processor s": seconds / count, "shapes": float(np.mean([entry.truth or 0 for entry in entries[1:]]))}


def checks(count: int) -> dict[str, Any]:
    """Measure checks of random configurations near the start by MuJoCo and by kernels, and compare their verdicts."""
    from greenhouse_gym.motion.kernel_checker import search_checker

    bank, arm, total = SceneBank.open("default"), get_robot("ur5e"), {"mujoco": 0.0, "kernel": 0.0, "single": 0.0}
    names, rng, differ, size = bank.names("test"), np.random.default_rng(0), 0, 2000
    for name in names[:: len(names) // count][:count]:
        exact = checker_of(compile_scene(bank.scene(name), arm), 0)
        kernel = search_checker(exact.model, exact.reaches)
        q = np.clip(arm.rating_start + rng.normal(0, 0.6, (size, len(arm.joints))), arm.lower, arm.upper)
        known = CollisionChecker.are_free(exact, q)
        differ += int((kernel.are_free(q) != known).sum())
        total["mujoco"] += seconds_of(partial(exact.are_free, q), time.process_time)
        total["kernel"] += seconds_of(partial(kernel.are_free, q), time.process_time)
        total["single"] += seconds_of(partial(CollisionChecker.are_free, kernel, q), time.process_time)
    each = {f"{name}, us": 1e6 * seconds / (size * count) for name, seconds in total.items()}
    return {**each, "verdicts that differ": differ, "verdicts": size * count}


def plans(count: int) -> dict[str, Any]:
    """Measure whole plans, with goals and proof, to validation targets of each difficulty."""
    bank, rng = SceneBank.open("default"), np.random.default_rng(0)
    todo: dict[str, list[tuple[Scene, int]]] = {name: [] for name in DIFFICULTIES[:3]}
    for name in rng.permutation(bank.names("validation")):
        scene = bank.scene(str(name))
        for difficulty, chosen in todo.items():
            known = [t.tomato for t in scene.targets if t.difficulty == difficulty and t.robot == "ur5e"]
            chosen += [(scene, int(tomato)) for tomato in rng.permutation(known)[:3]]
    plan(*todo["easy"][0], max_checks=10, time_limit=None)  # starts the planning process
    results: dict[str, Any] = {}
    for difficulty, chosen in todo.items():
        solved, seconds = 0, []
        for scene, tomato in chosen[:count]:
            before = processor_seconds()
            solved += plan(scene, tomato, max_checks=CHECKS, time_limit=None, start="upright").path is not None
            seconds.append(processor_seconds() - before)
        results[difficulty] = {
            "solved": solved,
            "of": len(seconds),
            "mean ms": round(1000 * float(np.mean(seconds)), 1),
            "median ms": round(1000 * float(np.median(seconds)), 1),
        }
    return results


def depth_images(count: int) -> dict[str, Any]:
    """Measure depth images of 128 x 96 pixels in true rows, by MuJoCo in the whole model and by the ray caster."""
    bank, arm, camera = SceneBank.open("default"), get_robot("ur5e"), DepthCamera(width=128, height=96)
    entries = [entry for entry in bank.manifest.scenes if entry.truth][:count]
    worlds = Worlds(arm, "truth", capacity_of(bank, "truth"))
    total, differ = {"mujoco, ms": 0.0, "ray caster, ms": 0.0}, 0
    for entry in entries:
        compiled = worlds.world(bank.scene(entry.name)).compiled
        model, data, caster = compiled.model, mujoco.MjData(compiled.model), RayCaster(compiled)
        data.qpos[:] = arm.start
        mujoco.mj_kinematics(model, data)
        turn = data.site_xmat[compiled.tip_site].reshape(3, 3)
        origin = data.site_xpos[compiled.tip_site] + turn @ TIP_FROM_WRIST[:3, 3]
        rays = camera.rays @ turn.T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        geom, known = np.empty(len(rays), np.int32), np.empty(len(rays))
        cast = partial(caster.cast, model, data.qpos.copy(), origin, rays, 2 * MAX_RANGE)
        whole = partial(
            mujoco.mj_multiRay, model, data, origin, rays.reshape(-1), None, True, -1, geom, known, None, len(rays),
            2 * MAX_RANGE,
        )  # fmt: skip
        total["mujoco, ms"] += 1000 * seconds_of(whole, time.process_time)
        differ += int((cast().distance != known).sum())
        total["ray caster, ms"] += 1000 * seconds_of(cast, time.process_time)
    return {name: value / count for name, value in total.items()} | {"pixels that differ": differ}


def watchful(count: int) -> dict[str, Any]:
    """Measure episodes of `WatchfulAgent` in true rows of the validation split."""
    options: dict[str, Any] = {"seed": 0, "physics": "truth", "split": "validation", "progress": False}
    evaluate(WatchfulAgent(), episodes=1, **options)  # compiles what all share
    before = processor_seconds()
    records = evaluate(WatchfulAgent(), episodes=count, **options).records
    return {
        "processor s an episode": (processor_seconds() - before) / count,
        "reached": sum(record.success for record in records),
        "of": count,
        "steps": float(np.mean([record.steps for record in records])),
    }


if __name__ == "__main__":
    main()
