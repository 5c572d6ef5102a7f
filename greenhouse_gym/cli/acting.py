"""Commands on scenes: plan, render."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import track

from greenhouse_gym.common.progress import CONSOLE, say

if TYPE_CHECKING:
    from greenhouse_gym.planning import PlanResult

Bank = Annotated[str, typer.Option(help="A shipped bank's name or a bank's folder.")]


def plan(
    scene: Annotated[str, typer.Option(help="Name of the scene in the bank; its first one by default.")] = "",
    target: Annotated[int, typer.Option(help="Index of the tomato in the scene.")] = 0,
    planner: Annotated[str, typer.Option(help="Name of a planner.")] = "RRTConnect",
    all_planners: Annotated[bool, typer.Option("--all", help="Run all planners.")] = False,
    bank: Bank = "default",
    robot: Annotated[str, typer.Option(help="Name or file of the arm.")] = "ur5e",
    time_limit: Annotated[
        float | None, typer.Option(help="Seconds per planner; 5 unless --max-checks limits it.")
    ] = None,
    max_checks: Annotated[int | None, typer.Option(help="Collision checks after which a planner stops.")] = None,
    setting: Annotated[
        list[str] | None, typer.Option("--set", help="A parameter of the planner, such as range=0.5; may be repeated.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the goal search and the planner.")] = 0,
    picture: Annotated[Path | None, typer.Option(help="PNG file for a picture of the shortest path.")] = None,
) -> None:
    """Plan a path to a tomato with one planner, or with all of them on the same goals, and print a table.

    BiTRRT, CForest, pRRT and pSBL have no Python bindings in OMPL 1.7.0 and are called by the memory layout of that
    wheel; with another build they may end as "crashed".
    """
    from greenhouse_gym.errors import InvalidValueError
    from greenhouse_gym.planning import PLANNERS, goal_configurations, resample
    from greenhouse_gym.planning import plan as plan_path
    from greenhouse_gym.rendering.task_pictures import picture_of_path
    from greenhouse_gym.scene import SceneBank

    if time_limit is None and max_checks is None:
        time_limit = 5.0
    if all_planners and setting:
        raise InvalidValueError("--set needs one planner; it does not go with --all")
    opened = SceneBank.open(bank)
    chosen = opened.scene(scene) if scene else opened[0]
    settings = _settings(setting or [])
    if not all_planners:
        PLANNERS[planner].with_settings(settings)  # raises before the goals are searched
    goals = goal_configurations(chosen, target, robot, seed=seed)
    results = []
    for name in track(list(PLANNERS) if all_planners else [planner], "planning", disable=not CONSOLE.is_terminal):
        results.append(
            plan_path(chosen, target, robot, name, time_limit, max_checks, goals, seed=seed, settings=settings)
        )
    typer.echo(_plan_table(results), nl=False)
    for result in results:
        if result.message:
            typer.echo(f"{result.planner}: {result.message.splitlines()[0]}")
    solved = [result for result in results if result.path is not None]
    if not solved:
        raise typer.Exit(2)
    if picture is not None:
        from greenhouse_gym.reporting.pictures import save

        best = min(solved, key=lambda result: result.length)
        assert best.path is not None
        save(picture_of_path(chosen, robot, target, resample(best.path, 0.03)), picture)
        say(f"{best.planner}'s path in {picture}")


def _settings(texts: Sequence[str]) -> dict[str, bool | int | float]:
    """Parse settings such as range=0.5.

    Raises:
        InvalidValueError: A text is not a name and a value.
    """
    from greenhouse_gym.errors import InvalidValueError

    values: dict[str, bool | int | float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            parsed = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            parsed = None
        if not isinstance(parsed, bool | int | float):
            raise InvalidValueError(f"--set {text!r}: expected a name and a number, True or False, such as range=0.5")
        values[name] = parsed
    return values


def _plan_table(results: Sequence[PlanResult]) -> str:
    heads = ["planner", "status", "seconds", "first s", "checks", "nodes", "raw rad", "rad", "clearance mm"]
    rows = [heads, ["---"] * 2 + ["---:"] * 7]
    for r in results:
        found = r.path is not None
        rows.append(
            [
                r.planner,
                r.status,
                f"{r.planning_time:.3f}",
                f"{r.costs[0, 0]:.3f}" if found else "",
                str(r.checks),
                str(r.tree_size),
                f"{r.raw_length:.2f}" if found else "",
                f"{r.length:.2f}" if found else "",
                f"{1000 * r.clearance:.0f}" if found else "",
            ]
        )
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


def parts(text: str) -> tuple[str, ...]:
    """The parts of a list that is separated by commas."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def render(
    scene: Annotated[str, typer.Option(help="Name of the scene in the bank; its first one by default.")] = "",
    out: Annotated[Path, typer.Option(help="PNG file to write.")] = Path("scene.png"),
    target: Annotated[int, typer.Option(help="Index of the tomato that the red line leads to.")] = 0,
    bank: Bank = "default",
) -> None:
    """Draw a scene with the arm at its start."""
    from greenhouse_gym.rendering.task_pictures import picture_of_path
    from greenhouse_gym.reporting.pictures import save
    from greenhouse_gym.robots import get_robot
    from greenhouse_gym.scene import SceneBank

    arm = get_robot("ur5e")
    opened = SceneBank.open(bank)
    save(picture_of_path(opened.scene(scene) if scene else opened[0], arm, target, arm.start[None]), out)
    say(f"picture in {out}")
