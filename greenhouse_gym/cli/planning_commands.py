"""Commands on arms and scenes: plan, render, mount, rate, brush."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from greenhouse_gym.cli.options import Bank, BankArgument, Robot, SceneName, Target, planner_names, scene_in, set_option
from greenhouse_gym.common.progress import progress, say

if TYPE_CHECKING:
    from greenhouse_gym.common.tables import Table
    from greenhouse_gym.planning import PlanResult


def plan(
    scene: SceneName = "",
    target: Target = 0,
    planner: Annotated[
        str, typer.Option(help="Name of the planner, see `greenhouse-gym list planners`.", autocompletion=planner_names)
    ] = "RRTConnect",
    all_planners: Annotated[bool, typer.Option("--all", help="Run every planner.")] = False,
    bank: Bank = "default",
    robot: Robot = "ur5e",
    time_limit: Annotated[
        float | None, typer.Option(help="Seconds per planner; 5 unless --max-checks is given.")
    ] = None,
    max_checks: Annotated[int | None, typer.Option(help="Collision checks after which a planner stops.")] = None,
    leaves: Annotated[
        str, typer.Option(help="rigid, or brush to plan through leaves where no path leads around them.")
    ] = "rigid",
    setting: Annotated[list[str] | None, set_option("range=0.5")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the goal search and the planner.")] = 0,
    picture: Annotated[Path | None, typer.Option(help="PNG or JPEG file for a picture of the shortest path.")] = None,
) -> None:
    """Plan a path to a tomato with one planner, or with all planners and the same goals, and print a table.

    The table holds the planning time, the collision checks, the length and clearance of the shortened path, and the
    number of shapes of leaves that it brushes. BiTRRT, CForest, pRRT and pSBL have no Python bindings in OMPL 1.7.0
    and are called by the memory layout of that wheel; with another build they may end as "crashed".
    """
    from greenhouse_gym.common.settings_files import assigned
    from greenhouse_gym.errors import InvalidValueError
    from greenhouse_gym.planning import PLANNERS, goal_configurations, resample
    from greenhouse_gym.planning import plan as plan_path
    from greenhouse_gym.rendering.picture_files import require_picture, write_picture
    from greenhouse_gym.rendering.task_pictures import picture_of_path
    from greenhouse_gym.scene import SceneBank

    if time_limit is None and max_checks is None:
        time_limit = 5.0
    if all_planners and setting:
        raise InvalidValueError("--set needs one planner; it does not go with --all")
    if picture is not None:
        require_picture(picture)
    chosen = scene_in(SceneBank.open(bank), scene)
    settings = {name: value for text in setting or () for name, value in assigned(text).items()}
    if not all_planners:
        PLANNERS[planner].with_settings(settings)  # raises before the goals are searched
    with progress("searching goals"):
        goals = goal_configurations(chosen, target, robot, seed=seed, leaves=leaves)
    names = list(PLANNERS) if all_planners else [planner]
    results: list[PlanResult] = []
    with progress("planners", len(names)) as on_progress:
        for name in names:
            on_progress(len(results), name)
            results.append(
                plan_path(
                    chosen, target, robot, name, time_limit, max_checks, goals, seed=seed, settings=settings,
                    leaves=leaves,
                )
            )  # fmt: skip
    _plan_table(results).show()
    for result in results:
        if result.message:
            typer.echo(f"{result.planner}: {result.message.splitlines()[0]}")
    solved = [result for result in results if result.path is not None]
    if not solved:
        raise typer.Exit(2)
    if picture is not None:
        best = min(solved, key=lambda result: result.length)
        assert best.path is not None
        with progress("drawing"):
            write_picture(picture_of_path(chosen, robot, target, resample(best.path, 0.03)), picture)
        say(f"path of {best.planner} in {picture}")


def _plan_table(results: Sequence[PlanResult]) -> Table:
    from greenhouse_gym.common.tables import Table

    rows = []
    for r in results:
        found = ("",) * 3
        if r.path is not None:
            found = (f"{r.length:.2f}", f"{1000 * r.clearance:.0f}", str(r.brushed_leaves))
        rows.append((r.planner, r.status, f"{r.planning_time:.3f}", f"{r.checks:,}", *found))
    return Table(("planner", "status", "seconds", "checks", "path rad", "clearance mm", "leaves"), rows, words=(0, 1))


def render(
    scene: SceneName = "",
    out: Annotated[Path, typer.Option(help="PNG or JPEG file to write.")] = Path("scene.png"),
    target: Target = 0,
    bank: Bank = "default",
    robot: Robot = "ur5e",
) -> None:
    """Draw a scene with the arm in its start configuration and a red line to the target."""
    from greenhouse_gym.rendering.picture_files import require_picture, write_picture
    from greenhouse_gym.rendering.task_pictures import picture_of_path
    from greenhouse_gym.robots import get_robot
    from greenhouse_gym.scene import SceneBank

    require_picture(out)
    arm = get_robot(robot)
    with progress("drawing"):
        write_picture(picture_of_path(scene_in(SceneBank.open(bank), scene), arm, target, arm.start[None]), out)
    say(f"picture in {out}")


def mount(
    arm: Annotated[
        Path,
        typer.Argument(help="MJCF file of the arm, without a tool, as MuJoCo Menagerie has them (extra menagerie)."),
    ],
    out: Annotated[Path, typer.Option(help="File to write.")],
    flange: Annotated[
        str | None, typer.Option(help="Name of the site at the flange; the usual names are recognized.")
    ] = None,
) -> None:
    """Write a copy of an arm's file with the package's gripper at its flange and a collision-free start."""
    from greenhouse_gym.robots import get_robot, mount_tool

    with progress("searching a start"):
        robot = get_robot(mount_tool(arm, out, flange))
    start = ", ".join(f"{name} {value:.2f}" for name, value in zip(robot.joints, robot.start, strict=True))
    say(f"{out}: starts at {start}")


def rate(
    bank: BankArgument,
    robot: Robot,
    out: Annotated[Path, typer.Option(help="Folder of the new bank.")],
    seed: Annotated[int, typer.Option(help="Seed of the goal searches and planners.")] = 0,
    per_scene: Annotated[int | None, typer.Option(min=1, help="Rate only this many targets, the nearest.")] = None,
) -> None:
    """Rate the targets of a bank for another arm and write a new bank; resumes an interrupted run."""
    from greenhouse_gym.planning.rated_banks import rate_bank
    from greenhouse_gym.robots import get_robot
    from greenhouse_gym.scene import SceneBank

    opened, arm = SceneBank.open(bank), get_robot(robot)
    with progress("targets", sum(len(scene.tomatoes[:per_scene]) for scene in opened)) as on_progress:
        rated = rate_bank(opened, arm, out, seed, per_scene, on_progress)
    counts = Counter(t.difficulty for scene in rated for t in scene.targets if t.robot == arm.name)
    found = ", ".join(f"{count} {difficulty}" for difficulty, count in counts.most_common())
    say(f"{len(rated)} scenes in {out}, targets for {arm.name}: {found}")


def brush(
    bank: BankArgument,
    out: Annotated[Path, typer.Option(help="Folder of the new bank.")],
    robot: Robot = "ur5e",
    seed: Annotated[int, typer.Option(help="Seed of the goal searches and planners.")] = 0,
) -> None:
    """Rate the targets of a bank with leaves that give way too, and write a new bank; resumes an interrupted run."""
    from greenhouse_gym.planning.rated_banks import brush_bank
    from greenhouse_gym.robots import get_robot
    from greenhouse_gym.scene import SceneBank

    opened, arm = SceneBank.open(bank), get_robot(robot)
    with progress("scenes", len(opened)) as on_progress:
        rated = brush_bank(opened, out, arm, seed, on_progress)
    certificates = [t.brush for scene in rated for t in scene.targets if t.robot == arm.name and t.brush is not None]
    counts = Counter(certificate.difficulty for certificate in certificates)
    found = ", ".join(f"{count} {difficulty}" for difficulty, count in counts.most_common())
    through = sum(certificate.witness is not None for certificate in certificates)
    say(f"{len(rated)} scenes in {out}, where leaves give way: {found}; {through} are reached through leaves alone")
