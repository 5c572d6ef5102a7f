"""The scan, what it left unknown, and the true row: with a path that did not hold beside one that did.

    python benchmarks/capture_protocols_picture.py --row 711 --workdir capture_protocols
    python benchmarks/capture_protocols_picture.py --bank default --split validation --workdir careful_plans

Takes scenes and episodes that `capture_protocols.py` or, with --bank, `careful_plans.py` left in --workdir: a tomato
that the first protocol's plan (or the one for which unknown space is free) did not reach in the truth and the second
one's (or the one that keeps out of it) did.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from capture_protocols import episodes_of, plan_of
from capture_protocols_rows import Options, folder_of, scenes_in
from capture_protocols_summary import Episode
from careful_plans import file_of
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from greenhouse_gym.agents import Problem
from greenhouse_gym.agents.planner_agent import PathFollower
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import planning_model
from greenhouse_gym.planning import CollisionChecker, resample
from greenhouse_gym.rendering.renderer import Viewpoint
from greenhouse_gym.rendering.task_pictures import picture_of_path
from greenhouse_gym.robots import get_robot
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.scene import Scene, SceneBank, compile_scene

VIEW = Viewpoint((-0.75, -1.7, 1.75), (0.25, 0.0, 1.25))
COLORS = ListedColormap(["0.55", "white", "#2e7d32"])  # unknown, empty, surface


def draw(cases: Sequence[tuple[Scene, Episode]], options: Options, out: Path) -> None:
    """Draw plans for one tomato, each with what became of it in the truth, one above the other."""
    known = all(
        scene.occupancy is not None for scene, _ in cases
    )  # scenes of an older version do not say what was seen
    figure, axes = plt.subplots(len(cases), 2 + known, figsize=(10 + 5 * known, 8), constrained_layout=True)
    for line, (scene, episode) in zip(axes, cases, strict=True):
        target = episode["target"]
        path = _path(scene, episode, options)
        until = _first_contact(scene, target, path, options)
        followed = path if until is None else path[: until + 1]
        line[0].imshow(picture_of_path(scene, options.robot, target, path, VIEW))
        line[0].set_title(f"{episode['protocol']}, unknown {episode['unknown']}: planned on the scan")
        if known:
            _unknown_slice(line[1], scene, target, path, options.robot)
        line[-1].imshow(picture_of_path(_true(scene), options.robot, _nearest(scene, target), followed, VIEW))
        line[-1].set_title(f"in the true row: {episode['outcome']}")
        for axis in (line[0], line[-1]):
            axis.axis("off")
    figure.savefig(out, dpi=80)


def of_protocols(
    row: int, protocols: Sequence[str], starts: Sequence[str], unknown: str, options: Options
) -> list[tuple[Scene, Episode]]:
    """Scenes and episodes of a tomato that the first protocol's plan did not reach, and the second one's did."""
    first, second = (episodes_of(row, p, s, unknown, options) for p, s in zip(protocols, starts, strict=True))
    held = {(e["scene"], e["match"]): e for e in second if e["outcome"] == "reached" and e["match"] is not None}
    for episode in filter(_hit_a_leaf, first):
        for key, other in held.items():
            if key[0] == episode["scene"] and np.allclose(episode["place"], other["place"], atol=0.05):
                folders = [folder_of(row, protocol, options) for protocol in protocols]
                scenes = [next(s for s in scenes_in(folder) if s.name == key[0]) for folder in folders]
                return list(zip(scenes, (episode, other), strict=True))
    raise SystemExit(f"row {row}: no tomato that {protocols[0]} missed and {protocols[1]} reached; try another row")


def of_bank(bank: SceneBank, split: str, careful: str, options: Options) -> list[tuple[Scene, Episode]]:
    """A scene, twice, with the episodes of a tomato that only the careful plan reached."""
    for name in bank.names(split):
        free, kept_out = (
            json.loads(file_of(name, "folded", unknown, options).read_text()) for unknown in ("free", careful)
        )
        held = {e["target"]: e for e in kept_out if e["outcome"] == "reached"}
        for episode in filter(_hit_a_leaf, free):
            if episode["target"] in held:
                return [(bank.scene(name), episode), (bank.scene(name), held[episode["target"]])]
    raise SystemExit(f"split {split}: no tomato that only the careful plan reached; try another split")


def _hit_a_leaf(episode: Episode) -> bool:
    return episode["outcome"] == "collided" and any(c.startswith("clutter") for c in episode["contact"])


def _path(scene: Scene, episode: Episode, options: Options) -> Array:
    """The commands of an episode, planned again."""
    robot, target, start = get_robot(options.robot), episode["target"], episode["start"]
    found = plan_of(scene, target, episode["unknown"], start, options)
    assert found.path is not None
    commands = PathFollower(found.path, Problem(scene, target, robot, robot.starts[start]), proven=True).commands
    return resample(commands, 0.01)  # radians: leaves are thin


def _true(scene: Scene) -> Scene:
    assert scene.truth is not None
    truth = scene.truth
    return scene.model_copy(
        update={
            "tomatoes": truth.tomatoes,
            "stems": truth.stems,
            "clutter": truth.clutter,
            "truth": None,
            "targets": (),
        }
    )


def _nearest(scene: Scene, target: int) -> int:
    assert scene.truth is not None
    gaps = [np.linalg.norm(t.center - scene.tomatoes[target].center) for t in scene.truth.tomatoes]
    return int(np.argmin(gaps))


def _first_contact(scene: Scene, target: int, path: Array, options: Options) -> int | None:
    model = planning_model(compile_scene(_true(scene), options.robot), _nearest(scene, target), margin=0.0)
    checker = CollisionChecker(model)
    return next((i for i, configuration in enumerate(path) if not checker.is_free(configuration)), None)


def _unknown_slice(axis: Axes, scene: Scene, target: int, path: Array, robot: str) -> None:
    """What was seen of the upright plane through the target, across the row, and the tip's way."""
    assert scene.occupancy is not None
    compiled = compile_scene(scene, robot)
    tips = tool_state(tool_chain(compiled.model, compiled.tip_site), path).point
    center = scene.tomatoes[target].center
    x, z = np.meshgrid(np.arange(-0.6, 1.2, 0.01), np.arange(0.2, 2.3, 0.01))
    points = np.column_stack([x.ravel(), np.full(x.size, center[1]), z.ravel()])
    axis.imshow(
        scene.occupancy.states_at(points).reshape(x.shape),
        origin="lower",
        extent=(-0.6, 1.2, 0.2, 2.3),
        cmap=COLORS,
        vmin=0,
        vmax=2,
    )
    axis.plot(tips[:, 0], tips[:, 2], color="deeppink")
    axis.plot(center[0], center[2], "o", color="red")
    axis.set(
        xlabel="from the arm into the row, m", ylabel="height, m", title="unknown gray, surface green; the tip's way"
    )


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--row", type=int, default=711)
    parser.add_argument("--source", default="own")
    parser.add_argument("--length", type=float, default=2.0)
    parser.add_argument("--spacing", type=float, default=0.5)
    parser.add_argument("--per-scene", type=int, default=20)
    parser.add_argument("--protocols", nargs=2, default=["paper", "upright-back"])
    parser.add_argument("--starts", nargs=2, default=["start", "folded"])
    parser.add_argument("--unknown", help="how plans treated unknown space: free, or with --bank 0.15, if left out")
    parser.add_argument("--checks", type=int, default=20_000)
    parser.add_argument("--margin", type=float, default=0.0, help="how far paths kept from boxes of leaves, metres")
    parser.add_argument("--bank")
    parser.add_argument("--split", default="validation", help="of the bank")
    parser.add_argument("--workdir", type=Path, default=Path("capture_protocols"))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "capture_protocols.png")
    a = parser.parse_args()
    options = Options(
        source=a.source, length=a.length, spacing=a.spacing, checks=a.checks, per_scene=a.per_scene, margin=a.margin,
        workdir=a.workdir if a.bank is None else a.workdir / a.bank,
    )  # fmt: skip
    if a.bank is None:
        cases = of_protocols(a.row, a.protocols, a.starts, a.unknown or "free", options)
    else:
        cases = of_bank(SceneBank.open(a.bank), a.split, a.unknown or "0.15", options)
    draw(cases, options, a.out)


if __name__ == "__main__":
    main()
