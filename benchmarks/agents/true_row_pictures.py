"""Draw a plan that failed in the true row above one that held: plan on the scan, occupancy grid, and true row.

python -m benchmarks.agents.true_row_pictures --split validation --unknown free 0.15 --out unknown_space.png
python -m benchmarks.agents.true_row_pictures --row 711 --protocols paper upright-back --starts start folded

The target is the first tomato on whose path the first plan hits a leaf and the second does not. The two plans differ in
how they treat unknown space, in the start of the arm or, with ``--row``, in the protocol by which the row was scanned
(see `scanned_rows.py`). Takes some minutes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from benchmarks.agents.scanned_rows import ScannedRow
from benchmarks.agents.true_row_figures import SAME_TOMATO
from benchmarks.agents.true_rows import ROBOT, options_from, within_reach
from benchmarks.common import RESULTS, parser
from greenhouse_gym.agents import PlannerAgent, Problem
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import planning_model
from greenhouse_gym.planning import CollisionChecker, resample
from greenhouse_gym.rendering.renderer import Viewpoint
from greenhouse_gym.rendering.task_pictures import picture_of_path
from greenhouse_gym.robots import get_robot
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.scene import Scene, SceneBank, compile_scene
from greenhouse_gym.scene.truth import true_scene

VIEW = Viewpoint((-0.75, -1.7, 1.75), (0.25, 0.0, 1.25))
COLORS = ListedColormap(["0.55", "white", "#2e7d32"])  # unknown, free, occupied
STEP = 0.01  # rad between checked configurations: leaves are thin


class Followed(NamedTuple):
    """A path (k, joints) to a tomato of a scene; the index of its first configuration in collision in the truth."""

    scene: Scene
    target: int
    path: Array
    contact: int | None


def follow(scene: Scene, target: int, agent: PlannerAgent, start: str) -> Followed | None:
    """Plan on the scan and check the path in the truth; None without a plan."""
    robot, true = get_robot(ROBOT), true_scene(scene)
    agent.reset(Problem(scene, target, robot, robot.configuration(start)))
    if agent.result is None or agent.result.path is None:
        return None
    path = resample(agent.result.path, STEP)
    nearest, _ = nearest_tomato(true, scene.tomatoes[target].center)
    checker = CollisionChecker(planning_model(compile_scene(true, ROBOT), nearest, margin=0.0))
    contact = next((i for i, configuration in enumerate(path) if not checker.is_free(configuration)), None)
    return Followed(scene, target, path, contact)


def nearest_tomato(scene: Scene, point: Array) -> tuple[int, float]:
    """Return the tomato nearest to a point (3,) and its distance, m."""
    gaps = [float(np.linalg.norm(tomato.center - point)) for tomato in scene.tomatoes]
    return int(np.argmin(gaps)), min(gaps)


def pairs(banks: Sequence[SceneBank], split: str, count: int) -> Iterator[tuple[tuple[Scene, int], tuple[Scene, int]]]:
    """Yield the tomatoes within reach that both banks hold, each with its scenes."""
    for name in banks[0].names(split):
        first, second = (bank.scene(name) for bank in banks)
        for target in within_reach(first, count, 0):
            other, gap = nearest_tomato(second, first.tomatoes[target].center)
            if gap < SAME_TOMATO:
                yield (first, target), (second, other)


def draw_line(line: Sequence[Axes], title: str, followed: Followed) -> None:
    """Draw the plan on the scan, its path in the occupancy grid, and what became of it in the truth."""
    scene, target, path, contact = followed
    true = true_scene(scene)
    nearest, _ = nearest_tomato(true, scene.tomatoes[target].center)
    until = path if contact is None else path[: contact + 1]
    line[0].imshow(picture_of_path(scene, ROBOT, target, path, VIEW))
    line[0].set_title(f"{title}: planned on the scan")
    line[2].imshow(picture_of_path(true, ROBOT, nearest, until, VIEW))
    line[2].set_title(f"in the true row: {'reached' if contact is None else 'collided'}")
    for axis in (line[0], line[2]):
        axis.axis("off")
    assert scene.occupancy is not None
    compiled, center = compile_scene(scene, ROBOT), scene.tomatoes[target].center
    tips = tool_state(tool_chain(compiled.model, compiled.tip_site), path).point
    x, z = np.meshgrid(np.arange(-0.6, 1.2, 0.01), np.arange(0.2, 2.3, 0.01))
    points = np.column_stack([x.ravel(), np.full(x.size, center[1]), z.ravel()])
    states = scene.occupancy.states_at(points).reshape(x.shape)
    line[1].imshow(states, origin="lower", extent=(-0.6, 1.2, 0.2, 2.3), cmap=COLORS, vmin=0, vmax=2)
    line[1].plot(tips[:, 0], tips[:, 2], color="deeppink")
    line[1].plot(center[0], center[2], "o", color="red")
    line[1].set(xlabel="distance into the row, m", ylabel="height, m", title="unknown gray, occupied green")


def main() -> None:
    """Find a tomato and draw both plans."""
    command = parser(__doc__)
    command.add_argument("--bank", default="default")
    command.add_argument("--split", default="validation")
    command.add_argument("--row", type=int, help="seed of an own row to scan by both protocols instead")
    command.add_argument("--protocols", nargs=2, default=["paper", "upright-back"])
    command.add_argument("--starts", nargs=2, default=["folded", "folded"])
    command.add_argument("--unknown", nargs=2, default=["free", "free"], help="rules or depths for unknown space")
    command.add_argument("--checks", type=int, default=10_000)
    command.add_argument("--per-scene", type=int, default=12)
    command.add_argument("--workdir", type=Path, default=Path("runs/true_rows"))
    command.add_argument("--out", type=Path, default=RESULTS / "true_rows_unknown_space.png")
    a = command.parse_args()
    banks, titles = [SceneBank.open(a.bank)] * 2, [f"unknown space {rule}" for rule in a.unknown]
    if a.row is not None:
        banks, titles = [ScannedRow(a.row, protocol=name).bank(a.workdir) for name in a.protocols], a.protocols
    options = [options_from([f"unknown={rule}"]) for rule in a.unknown]
    first, second = (PlannerAgent("RRTConnect", max_checks=a.checks, **own) for own in options)
    for one, other in pairs(banks, a.split if a.row is None else "test", a.per_scene):
        failed = follow(*one, first, a.starts[0])
        if failed is None or failed.contact is None:
            continue
        reached = follow(*other, second, a.starts[1])
        if reached is not None and reached.contact is None:
            figure, axes = plt.subplots(2, 3, figsize=(15, 8), constrained_layout=True)
            for line, title, followed in zip(axes, titles, (failed, reached), strict=True):
                draw_line(line, title, followed)
            figure.savefig(a.out, dpi=80)
            return
    raise SystemExit("no tomato on whose path only the first plan collides; try another split or row")


if __name__ == "__main__":
    main()
