"""Commands on banks of scenes: info, check, show, filter, grow, compose, export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from greenhouse_gym.cli.options import BankArgument, Robot, SceneName, scene_in
from greenhouse_gym.common.progress import progress, say


def _several(kind: str) -> Any:
    """Return the option that selects scenes by some of their properties."""
    return typer.Option(help=f"{kind} of the scenes to take; may be given several times; all by default.")


app = typer.Typer(help="List, inspect, check, filter, grow, compose and export banks of scenes.", no_args_is_help=True)


@app.command("list")
def list_banks() -> None:
    """List the shipped banks."""
    from greenhouse_gym.cli.doctor import bank_table

    bank_table().show()


@app.command()
def info(bank: BankArgument = "default") -> None:
    """Print a bank's statistics: rows, splits, styles, difficulties, known space."""
    from greenhouse_gym.scene import SceneBank
    from greenhouse_gym.scene.bank_statistics import as_markdown, bank_statistics

    opened = SceneBank.open(bank)
    with progress("scenes read", len(opened)) as on_progress:
        found = bank_statistics(opened, on_progress)
    typer.echo(f"# {opened.manifest.name}\n\n{opened.manifest.description}\n\n{as_markdown(found)}", nl=False)


@app.command()
def check(
    bank: BankArgument = "default",
    witnesses: Annotated[bool, typer.Option(help="Replay every witness in the simulator.")] = True,
) -> None:
    """Check files, checksums, manifest and witnesses of a bank; print its faults, with exit status 1 if it has any."""
    from greenhouse_gym.planning.audit import bank_faults
    from greenhouse_gym.scene import SceneBank

    opened = SceneBank.open(bank)
    with progress("scenes", len(opened)) as on_progress:
        faults = list(bank_faults(opened, witnesses, on_progress))
    for fault in faults:
        typer.echo(fault)
    if faults:
        raise typer.Exit(1)
    checked = "files, manifest and witnesses" if witnesses else "files and manifest"
    say(f"{opened.path}: {len(opened)} scenes; {checked} are correct")


@app.command()
def show(
    bank: BankArgument = "default",
    scene: SceneName = "",
    out: Annotated[Path, typer.Option(help="HTML file to write.")] = Path("scene.html"),
    robot: Robot = "ur5e",
) -> None:
    """Write an offline page that shows a scene in 3-D, with truth, occupancy and witnesses."""
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.reporting.scene_page import scene_page
    from greenhouse_gym.robots import get_robot
    from greenhouse_gym.scene import SceneBank

    chosen = scene_in(SceneBank.open(bank), scene)
    write_atomically(out, scene_page(chosen, get_robot(robot)))
    say(f"{chosen.name} in {out}")


@app.command("filter")
def filter_(
    bank: BankArgument,
    out: Annotated[Path, typer.Option(help="Folder of the new bank.")],
    join: Annotated[list[str] | None, typer.Option(help="Further banks; may be given several times.")] = None,
    name: Annotated[str, typer.Option(help="Name of the new bank; the folder's name by default.")] = "",
    split: Annotated[list[str] | None, _several("Split")] = None,
    row: Annotated[list[str] | None, _several("Row")] = None,
    week: Annotated[list[str] | None, _several("Growth week")] = None,
    style: Annotated[list[str] | None, _several("Fruit style")] = None,
    source: Annotated[list[str] | None, _several("Source of the plants")] = None,
    protocol: Annotated[list[str] | None, _several("Capture protocol")] = None,
    difficulty: Annotated[list[str] | None, _several("Difficulty of a target")] = None,
) -> None:
    """Write selected scenes as a new bank; with --join, scenes of several banks."""
    from greenhouse_gym.common.files import exclusive
    from greenhouse_gym.errors import InvalidValueError
    from greenhouse_gym.scene import SceneBank
    from greenhouse_gym.scene.bank import write_bank

    opened = SceneBank.join([bank, *join]) if join else SceneBank.open(bank)
    wanted: dict[str, Any] = {
        "split": split, "row": row, "week": week, "style": style, "source": source, "protocol": protocol,
        "difficulty": difficulty,
    }  # fmt: skip
    chosen = opened.select(**{kind: values for kind, values in wanted.items() if values})
    if any(out.resolve() == SceneBank.open(one).path for one in (bank, *(join or ()))):
        raise InvalidValueError(f"{out}: the new bank needs its own folder, not that of one of its sources")
    with exclusive(out):
        scenes = [(scene, chosen.split_of(scene.name)) for scene in chosen]
        made = write_bank(out, scenes, name or out.resolve().name, chosen.manifest.description)
    say(f"{len(made)} of {len(opened)} scenes in {out}")


@app.command()
def grow(
    out: Annotated[Path, typer.Option(help="Folder of the new bank.")],
    rows: Annotated[int, typer.Option(min=1, help="Number of rows of a metre; each takes minutes of one core.")] = 40,
    seed: Annotated[int, typer.Option(help="Seed of the first row; 10,000 or more.")] = 10_000,
    source: Annotated[str | None, typer.Option(help="Only plants of this source: own or helios.")] = None,
    processes: Annotated[int | None, typer.Option(min=1, help="Rows built at once; one per core by default.")] = None,
) -> None:
    """Grow new training rows, photograph and reconstruct them, and write a bank; resumes if interrupted."""
    from greenhouse_gym.build.grown import build_training_bank, training_recordings
    from greenhouse_gym.common import executors as parallel

    recordings = list(training_recordings(rows, seed, source))
    with parallel.processes(processes) as executor, progress("rows", rows) as on_progress:
        bank = build_training_bank(out, recordings, executor, on_progress)
    say(f"{len(bank)} scenes of {rows} rows in {out}")


@app.command()
def compose(
    bank: BankArgument,
    out: Annotated[Path, typer.Option(help="Folder of the new bank.")],
    scenes: Annotated[int, typer.Option(min=1, help="Number of scenes; each takes about a second.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the scenes.")] = 0,
    robot: Robot = "ur5e",
) -> None:
    """Write a bank of training scenes composed of the plants of a bank's training scenes; resumes if interrupted."""
    from greenhouse_gym.planning import ComposedBank

    with progress("scenes", scenes) as on_progress:
        ComposedBank(bank, scenes, seed, robot).write(out, on_progress)
    say(f"{scenes} scenes in {out}")


@app.command()
def export(
    bank: BankArgument,
    format: Annotated[
        str,
        typer.Option(help="One of mjcf, urdf, sdf, moveit, ply, obj, stl, vamp, robometrics, motionbenchmaker."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the files.")],
    scene: Annotated[list[str] | None, _several("Name")] = None,
    robot: Robot = "ur5e",
    truth: Annotated[bool, typer.Option("--truth", help="Write the true shapes, as moveit, ply, obj or stl.")] = False,
) -> None:
    """Write scenes in formats of other simulators and planners."""
    from greenhouse_gym.export import export_scene
    from greenhouse_gym.robots import get_robot
    from greenhouse_gym.scene import SceneBank

    opened, arm = SceneBank.open(bank), get_robot(robot)
    names = scene or opened.names()
    files = 0
    with progress("scenes", len(names)) as on_progress:
        for done, name in enumerate(names, start=1):
            files += len(export_scene(opened.scene(name), format, out, arm, truth))
            on_progress(done)
    say(f"{files} files in {out}")
