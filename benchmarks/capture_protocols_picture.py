"""The scan, what it left unseen, and the true row: with a path that did not hold beside one that did.

    python benchmarks/capture_protocols_picture.py --row 711 --workdir capture_protocols

Takes scenes and episodes that `capture_protocols.py` left in --workdir: a tomato that the first protocol's plan did not
reach in the truth and the second one's did.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from capture_protocols import Options, episodes_of, folder_of, scenes_in
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from greenhouse_gym.agents import Problem
from greenhouse_gym.agents.planner_agent import PathFollower
from greenhouse_gym.geometry import Array
from greenhouse_gym.planning import CollisionChecker, plan
from greenhouse_gym.planning.collision import planning_model
from greenhouse_gym.planning.kinematics import tool_chain, tool_state
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, compile_scene
from greenhouse_gym.scene.render import Viewpoint, picture_of_path

VIEW = Viewpoint((-0.75, -1.7, 1.75), (0.25, 0.0, 1.25))
COLORS = ListedColormap(["0.55", "white", "#2e7d32"])  # unseen, empty, surface


def draw(row: int, protocols: Sequence[str], starts: Sequence[str], unseen: str, options: Options, out: Path) -> None:
    """Draw two protocols' plans for one tomato, one above the other."""
    failed, held = _pair(row, protocols, starts, unseen, options)
    scenes = [
        next(scene for scene in scenes_in(folder_of(row, protocol, options)) if scene.name == episode["scene"])
        for episode, protocol in zip((failed, held), protocols, strict=True)
    ]
    known = all(scene.seen is not None for scene in scenes)  # scenes of an older version do not say what was seen
    figure, axes = plt.subplots(2, 2 + known, figsize=(10 + 5 * known, 8), constrained_layout=True)
    for line, scene, episode, protocol, start in zip(axes, scenes, (failed, held), protocols, starts, strict=True):
        path = _path(scene, episode["target"], start, unseen, options)
        until = _first_contact(scene, episode["target"], path, options)
        followed = path if until is None else path[: until + 1]
        line[0].imshow(picture_of_path(scene, options.robot, episode["target"], path, VIEW))
        line[0].set_title(f"{protocol}: planned on the scan")
        if known:
            _unseen_slice(line[1], scene, episode["target"], path, options.robot)
        line[-1].imshow(
            picture_of_path(_true(scene), options.robot, _nearest(scene, episode["target"]), followed, VIEW)
        )
        line[-1].set_title(f"in the true row: {episode['outcome']}")
        for axis in (line[0], line[-1]):
            axis.axis("off")
    figure.savefig(out, dpi=80)


def _pair(
    row: int, protocols: Sequence[str], starts: Sequence[str], unseen: str, options: Options
) -> tuple[dict[str, Any], dict[str, Any]]:
    """A tomato that the first protocol's plan did not reach, and the second one's did."""
    first, second = (episodes_of(row, p, s, unseen, options) for p, s in zip(protocols, starts, strict=True))
    leaves = [e for e in first if e["outcome"] == "collided" and any(c.startswith("clutter") for c in e["contact"])]
    held = {(e["scene"], e["match"]): e for e in second if e["outcome"] == "reached" and e["match"] is not None}
    for episode in leaves:
        for key, other in held.items():
            if key[0] == episode["scene"] and np.allclose(episode["place"], other["place"], atol=0.05):
                return episode, other
    raise SystemExit(f"row {row}: no tomato that {protocols[0]} missed and {protocols[1]} reached; try another row")


def _path(scene: Scene, target: int, start: str, unseen: str, options: Options) -> Array:
    """The commands of an episode, planned again."""
    robot = get_robot(options.robot)
    found = plan(scene, target, robot, options.planner, 120.0, options.checks, start=start, unseen=unseen)
    assert found.path is not None
    return PathFollower(found.path, Problem(scene, target, robot, robot.starts[start]), proven=True).commands


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


def _unseen_slice(axis: Axes, scene: Scene, target: int, path: Array, robot: str) -> None:
    """What was seen of the upright plane through the target, across the row, and the tip's way."""
    assert scene.seen is not None
    compiled = compile_scene(scene, robot)
    tips = tool_state(tool_chain(compiled.model, compiled.tip_site), path).point
    center = scene.tomatoes[target].center
    x, z = np.meshgrid(np.arange(-0.6, 1.2, 0.01), np.arange(0.2, 2.3, 0.01))
    points = np.column_stack([x.ravel(), np.full(x.size, center[1]), z.ravel()])
    axis.imshow(
        scene.seen.at(points).reshape(x.shape),
        origin="lower",
        extent=(-0.6, 1.2, 0.2, 2.3),
        cmap=COLORS,
        vmin=0,
        vmax=2,
    )
    axis.plot(tips[:, 0], tips[:, 2], color="deeppink")
    axis.plot(center[0], center[2], "o", color="red")
    axis.set(
        xlabel="from the arm into the row, m", ylabel="height, m", title="unseen gray, surface green; the tip's way"
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
    parser.add_argument("--unseen", default="free")
    parser.add_argument("--workdir", type=Path, default=Path("capture_protocols"))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "capture_protocols.png")
    a = parser.parse_args()
    options = Options(source=a.source, length=a.length, spacing=a.spacing, per_scene=a.per_scene, workdir=a.workdir)
    draw(a.row, a.protocols, a.starts, a.unseen, options, a.out)


if __name__ == "__main__":
    main()
