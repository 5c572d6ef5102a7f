"""Commands for arms from elsewhere: mount, rate."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from greenhouse_gym.common.progress import progress, say


def mount(
    arm: Annotated[Path, typer.Argument(help="The arm's MJCF file, without a tool.")],
    out: Annotated[Path, typer.Option(help="The file to write.")],
    flange: Annotated[str | None, typer.Option(help="Name of the site at the flange; common names are found.")] = None,
) -> None:
    """Write a copy of an arm's file with the package's gripper at its flange and a collision-free start."""
    from greenhouse_gym.robots import get_robot, mount_tool

    robot = get_robot(mount_tool(arm, out, flange))
    start = ", ".join(f"{name} {value:.2f}" for name, value in zip(robot.joints, robot.start, strict=True))
    say(f"{out}: starts at {start}")


def rate(
    bank: Annotated[str, typer.Argument(help="A shipped bank's name or a bank's folder.")],
    robot: Annotated[str, typer.Option(help="Name or file of the arm.")],
    out: Annotated[Path, typer.Option(help="Folder of the new bank.")],
    seed: Annotated[int, typer.Option(help="Seed of the goal searches and planners.")] = 0,
    per_scene: Annotated[
        int | None, typer.Option(min=1, help="Number of tomatoes to rate per scene, the nearest.")
    ] = None,
) -> None:
    """Rate the targets of a bank for another arm and write a new bank; resumes an interrupted run."""
    from greenhouse_gym.planning.certify import rate_bank
    from greenhouse_gym.robots import get_robot
    from greenhouse_gym.scene import SceneBank

    opened, arm = SceneBank.open(bank), get_robot(robot)
    with progress("targets", sum(len(scene.tomatoes[:per_scene]) for scene in opened)) as report:
        rated = rate_bank(opened, arm, out, seed, per_scene, report)
    mine = [target for scene in rated for target in scene.targets if target.robot == arm.name]
    counts = Counter(target.difficulty for target in mine)
    found = ", ".join(f"{count} {difficulty}" for difficulty, count in counts.most_common())
    say(f"{len(rated)} scenes in {out}, targets for {arm.name}: {found}")
