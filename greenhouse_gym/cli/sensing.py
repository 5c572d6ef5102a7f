"""Commands from a recording to a bank: simulate, reconstruct, build."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from greenhouse_gym.cli.scans import Floor, SeenFrom, Units, Up, scanned
from greenhouse_gym.cli.settings import Assignments, SettingsFile, shown
from greenhouse_gym.cli.spread import Address, Backend, Workers, spread
from greenhouse_gym.common.progress import CONSOLE, progress, say

if TYPE_CHECKING:
    from greenhouse_gym.capture import Recording
    from greenhouse_gym.reconstruction import ReconstructionSettings

Out = Annotated[Path, typer.Option("--out", help="Folder for the results.")]
Format = Annotated[str | None, typer.Option("--format", help="Format of the recording; found out when left out.")]


def _reconstruction_settings() -> object:
    from greenhouse_gym.reconstruction import ReconstructionSettings

    return ReconstructionSettings()


def _build_settings() -> object:
    from greenhouse_gym.build.scenes import BuildSettings

    return BuildSettings()


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder for the recording.")],
    seed: Annotated[int, typer.Option(help="Seed of the row, the walk and the noise.")] = 1,
    length: Annotated[float, typer.Option(help="Length of the row in metres.")] = 2.0,
    week: Annotated[int, typer.Option(help="Growth week, 0 = first harvest.")] = 0,
    style: Annotated[str, typer.Option(help="Fruit style: cluster, beefsteak or cherry; Helios has more.")] = "cluster",
    source: Annotated[str, typer.Option(help="Where plants come from: own or helios (extra plants).")] = "own",
    protocol: Annotated[
        str, typer.Option(help="How the row is photographed: paper, upright, back, upright-back, two-passes or wrist.")
    ] = "paper",
) -> None:
    """Grow a row and photograph it with a simulated rig."""
    from greenhouse_gym.capture import simulate_protocol, write_recording
    from greenhouse_gym.crops import grow_row

    recording = simulate_protocol(grow_row(seed, length, week, style, source=source), seed, protocol)
    with progress("stations", len(recording)) as done:
        write_recording(recording, out, lambda i: done(i + 1))
    say(f"{len(recording)} stations in {out}")


def reconstruct(
    recording: Annotated[Path, typer.Argument(help="A recording of any known format: a folder, or a bag.")],
    out: Out,
    method: Annotated[str, typer.Option(help="How to mesh: ball_pivoting, poisson or alpha_shape.")] = "ball_pivoting",
    points: Annotated[int, typer.Option(min=4, help="Points that the cloud is simplified to before meshing.")] = 10_000,
    faces: Annotated[int, typer.Option(min=1, help="Largest number of faces of the mesh.")] = 18_000,
    format: Format = None,
    poses: Annotated[
        str | None, typer.Option(help="Poses of the stations: estimate them, believe those given, or refine these.")
    ] = None,
    settings: SettingsFile = None,
    assignments: Assignments = None,
    print_settings: Annotated[bool, shown(_reconstruction_settings)] = False,
) -> None:
    """Turn a recording into a cloud and a mesh, with a report; an interrupted run goes on where it stopped.

    What is done so far is kept in the folder "walk" beside the results until all results are written.
    """
    from greenhouse_gym.capture import open_recording
    from greenhouse_gym.common.files import exclusive
    from greenhouse_gym.common.settings_files import resolve
    from greenhouse_gym.errors import require_choice
    from greenhouse_gym.reconstruction import METHODS, settings_for

    require_choice("meshing method", method, METHODS)
    opened = open_recording(recording, format)
    fitting = settings_for(opened)
    _say_what_fits(fitting)
    wanted = [*(assignments or ()), *([f"poses={poses}"] if poses else [])]
    resolved = resolve(fitting, settings, wanted)
    with exclusive(out):
        _reconstruct(opened, resolved, out, method, points, faces)


def _reconstruct(
    opened: Recording, settings: ReconstructionSettings, out: Path, method: str, points: int, faces: int
) -> None:
    from greenhouse_gym.cli.results import write_results
    from greenhouse_gym.errors import FileFormatError, ReconstructionError
    from greenhouse_gym.reconstruction import simplify_points, triangulate
    from greenhouse_gym.reconstruction.diary import Diary
    from greenhouse_gym.reconstruction.walk import walk_through

    notes = out / "walk"
    if notes.exists() and not (notes / "walk.jsonl").exists():
        raise FileFormatError(notes, "holds no notes of a reconstruction; choose another folder or remove it")
    noted = len(Diary.open(notes, opened, settings).entries)
    if noted:
        say(f"going on after station {noted - 1}")
    try:
        with progress("stations", len(opened)) as done:
            walk = walk_through(opened, settings, lambda i: done(i + 1), notes)
        with CONSOLE.status("merging, meshing, drawing"):
            rows, mesh = write_results(
                walk, opened, settings, lambda row: triangulate(simplify_points(row, points), method, faces),
                out, work=notes / "results",
            )  # fmt: skip
        shutil.rmtree(notes)
    except KeyboardInterrupt:
        noted = len(Diary.open(notes, opened, settings).entries)
        kept = f"{noted} of {len(opened)} stations are kept in {notes}"
        say(f"interrupted: {kept}; give the same command again to go on")
        raise typer.Exit(130) from None
    except ReconstructionError:
        shutil.rmtree(notes)
        raise
    for station in rows[0].report.stations:
        if station.reason:
            fate = "begins a new segment" if station.registered else "skipped"
            say(f"station {station.station} {fate}: {station.reason}")
    for warning in rows[0].report.warnings:
        say(f"warning: {warning}", style="red")
    registered, cloud = sum(row.registered.sum() for row in rows), sum(map(len, rows))
    say(f"{registered} of {len(opened)} stations, {cloud} points, {len(mesh.triangles)} faces: {out / 'report.html'}")


def _say_what_fits(settings: ReconstructionSettings) -> None:
    """Say which settings the recording itself made different from the defaults."""
    from dataclasses import asdict

    from greenhouse_gym.reconstruction import ReconstructionSettings

    usual = asdict(ReconstructionSettings())
    for name, value in asdict(settings).items():
        if value != usual[name]:
            say(f"from the recording: {name} = {value} instead of {usual[name]}; --set {name}=... overrides it")


def build(
    recordings: Annotated[list[Path], typer.Argument(help="Folders of recordings, or files of clouds, one per row.")],
    out: Out,
    name: Annotated[str, typer.Option(help="The bank's name; the folder's name by default.")] = "",
    format: Format = None,
    cloud: Annotated[bool, typer.Option("--cloud", help="The arguments are files of clouds, not recordings.")] = False,
    units: Units = None,
    up: Up = None,
    seen_from: SeenFrom = None,
    floor: Floor = None,
    settings: SettingsFile = None,
    assignments: Assignments = None,
    print_settings: Annotated[bool, shown(_build_settings)] = False,
    backend: Backend = None,
    workers: Workers = None,
    address: Address = "local",
) -> None:
    """Build a bank of scenes from recordings; an interrupted build goes on where it stopped.

    Settings of the reconstruction that are not given are those that the recordings' protocol needs.
    """
    from greenhouse_gym.common.extras import require_extras

    require_extras("reconstruct", "plan")
    from greenhouse_gym.build import build_bank
    from greenhouse_gym.build.scenes import BuildSettings
    from greenhouse_gym.capture import open_recording
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.common.settings_files import as_toml, resolve
    from greenhouse_gym.reconstruction import settings_for

    opened = [
        scanned(path, units, up, seen_from, floor) if cloud else open_recording(path, format) for path in recordings
    ]
    needed = {settings_for(recording) for recording in opened}
    resolved = resolve(
        BuildSettings(reconstruction=needed.pop() if len(needed) == 1 else None), settings, assignments or ()
    )
    try:
        with spread(backend, workers, address, len(opened)) as executor:
            bank = build_bank(opened, out, name or out.resolve().name, settings=resolved, executor=executor)
    except KeyboardInterrupt:
        say(f"interrupted: what is done is kept in {out}; give the same command again to go on")
        raise typer.Exit(130) from None
    write_atomically(out / "settings.toml", as_toml(resolved))
    say(f"{len(bank)} scenes in {out}")


def formats() -> None:
    """List the formats of recordings that can be read, those of installed packages too."""
    from greenhouse_gym.capture import recording_formats

    for known in recording_formats().values():
        say(f"{known.name}: {known.description}")


def build_shipped(
    out: Out = Path("scenes"),
    parts: Annotated[Path, typer.Option(help="Folder for the bank of each recording.")] = Path("runs/shipped"),
    processes: Annotated[
        int | None, typer.Option(min=1, help="Recordings built side by side; one per core by default.")
    ] = None,
    finished_only: Annotated[
        bool, typer.Option("--finished-only", help="Only join the parts that are finished.")
    ] = False,
) -> None:
    """Build the banks that ship with the package, from simulated recordings: default, and mini for tests.

    An interrupted build goes on where it stopped.
    """
    from greenhouse_gym.build.shipped import build_shipped_banks, join_parts
    from greenhouse_gym.common import executors as parallel

    if finished_only:
        banks = join_parts(parts, out)
    else:
        with parallel.processes(processes) as executor:
            banks = build_shipped_banks(out, parts, executor)
    for bank in banks:
        say(f"{bank.manifest.name}: {len(bank)} scenes in {bank.path}")
