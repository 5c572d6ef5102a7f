"""Commands on banks of scenes: info, check, show, filter, export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from greenhouse_gym.common.progress import progress, say

Bank = Annotated[str, typer.Argument(help="A shipped bank's name or a bank's folder.")]
Several = Annotated[list[str] | None, typer.Option(help="May be given several times; all when left out.")]

app = typer.Typer(
    help="Look at banks of scenes, check them, take parts of them, write them for others.", no_args_is_help=True
)


@app.command()
def info(bank: Bank = "default") -> None:
    """Print what is in a bank: rows, splits, styles, difficulties, seen share."""
    from greenhouse_gym.scene import SceneBank
    from greenhouse_gym.scene.bank_statistics import as_markdown, bank_statistics

    opened = SceneBank.open(bank)
    typer.echo(
        f"# {opened.manifest.name}\n\n{opened.manifest.description}\n\n{as_markdown(bank_statistics(opened))}", nl=False
    )


@app.command()
def check(
    bank: Bank = "default",
    witnesses: Annotated[bool, typer.Option(help="Replay every witness in the simulator's world.")] = True,
) -> None:
    """Check a bank's files, checksums, manifest and witnesses; each fault is a line, and the exit status is then 1."""
    from greenhouse_gym.planning.audit import bank_faults
    from greenhouse_gym.scene import SceneBank

    opened = SceneBank.open(bank)
    with progress("scenes", len(opened)) as report:
        faults = list(bank_faults(opened, witnesses, report))
    for fault in faults:
        typer.echo(fault)
    if faults:
        raise typer.Exit(1)
    what = "files, manifest and witnesses" if witnesses else "files and manifest"
    say(f"{opened.path}: {len(opened)} scenes; {what} are right")


@app.command()
def show(
    bank: Bank = "default",
    scene: Annotated[str, typer.Option(help="Name of the scene; the first one by default.")] = "",
    out: Annotated[Path, typer.Option(help="HTML file to write.")] = Path("scene.html"),
    robot: Annotated[str, typer.Option(help="Name or file of the arm.")] = "ur5e",
) -> None:
    """Write a page that shows a scene from all sides, with truth, seen space and witnesses; it needs no network."""
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.reporting.scene_page import scene_page
    from greenhouse_gym.robots import get_robot
    from greenhouse_gym.scene import SceneBank

    opened = SceneBank.open(bank)
    chosen = opened.scene(scene) if scene else opened[0]
    write_atomically(out, scene_page(chosen, get_robot(robot)))
    say(f"{chosen.name} in {out}")


@app.command("filter")
def filter_(
    bank: Bank,
    out: Annotated[Path, typer.Option(help="Folder of the new bank.")],
    join: Annotated[list[str] | None, typer.Option(help="Further banks; may be given several times.")] = None,
    name: Annotated[str, typer.Option(help="Name of the new bank; the folder's name by default.")] = "",
    split: Several = None,
    row: Several = None,
    week: Several = None,
    style: Several = None,
    source: Several = None,
    protocol: Several = None,
    difficulty: Several = None,
) -> None:
    """Write the scenes of some kinds as a new bank; with --join, those of several banks together."""
    from greenhouse_gym.common.files import exclusive
    from greenhouse_gym.errors import InvalidValueError
    from greenhouse_gym.scene import SceneBank
    from greenhouse_gym.scene.bank import write_bank

    opened = SceneBank.join([bank, *join]) if join else SceneBank.open(bank)
    asked: dict[str, Any] = {
        "split": split, "row": row, "week": week, "style": style, "source": source, "protocol": protocol,
        "difficulty": difficulty,
    }  # fmt: skip
    chosen = opened.select(**{kind: values for kind, values in asked.items() if values})
    if any(out.resolve() == SceneBank.open(one).path for one in (bank, *(join or ()))):
        raise InvalidValueError(f"{out}: the new bank needs a folder of its own, not that of a bank it is made of")
    with exclusive(out):
        scenes = [(scene, chosen.split_of(scene.name)) for scene in chosen]
        made = write_bank(out, scenes, name or out.resolve().name, chosen.manifest.description)
    say(f"{len(made)} of {len(opened)} scenes in {out}")


@app.command()
def export(
    bank: Bank,
    format: Annotated[
        str,
        typer.Option(help="One of mjcf, urdf, sdf, moveit, ply, obj, stl, vamp, robometrics, motionbenchmaker."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the files.")],
    scene: Several = None,
    robot: Annotated[str, typer.Option(help="Name or file of the arm.")] = "ur5e",
    truth: Annotated[
        bool, typer.Option("--truth", help="Write what really stands there, as moveit, ply, obj or stl.")
    ] = False,
) -> None:
    """Write scenes in the formats of other simulators and planners."""
    from greenhouse_gym.export import export_scene
    from greenhouse_gym.robots import get_robot
    from greenhouse_gym.scene import SceneBank

    opened, arm = SceneBank.open(bank), get_robot(robot)
    names = scene or opened.names()
    files = 0
    with progress("scenes", len(names)) as report:
        for done, name in enumerate(names, start=1):
            files += len(export_scene(opened.scene(name), format, out, arm, truth))
            report(done)
    say(f"{files} files in {out}")
