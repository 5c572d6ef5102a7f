"""Commands from a recording to a bank: simulate, reconstruct, build."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from greenhouse_gym.progress import CONSOLE, progress

Out = Annotated[Path, typer.Option("--out", help="Folder for the results.")]


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder for the recording.")],
    seed: Annotated[int, typer.Option(help="Seed of the row, the walk and the noise.")] = 1,
    length: Annotated[float, typer.Option(help="Length of the row in metres.")] = 2.0,
    week: Annotated[int, typer.Option(help="Growth week, 0 = first harvest.")] = 0,
    style: Annotated[str, typer.Option(help="Fruit style: cluster, beefsteak or cherry.")] = "cluster",
) -> None:
    """Grow a row and photograph it with a simulated rig."""
    from greenhouse_gym.capture import simulate_recording, write_recording
    from greenhouse_gym.plants import grow_row

    recording = simulate_recording(grow_row(seed, length, week, style), seed)
    with progress("stations", len(recording)) as done:
        write_recording(recording, out, lambda i: done(i + 1))
    CONSOLE.print(f"{len(recording)} stations in {out}")


def reconstruct(
    recording: Annotated[Path, typer.Argument(help="Folder of the recording.")],
    out: Out,
    points: Annotated[int, typer.Option(help="Points the cloud is simplified to before it is meshed.")] = 10_000,
    faces: Annotated[int, typer.Option(help="Most faces of the mesh.")] = 18_000,
) -> None:
    """Turn a recording into a cloud and a mesh, with a report."""
    from greenhouse_gym.capture import open_recording
    from greenhouse_gym.cli.pictures import row_pictures
    from greenhouse_gym.paths import write_atomically
    from greenhouse_gym.reconstruction import ReconstructionSettings, report_as_json, save_row, simplify_points
    from greenhouse_gym.reconstruction import triangulate as make_mesh
    from greenhouse_gym.reconstruction.row import merge_segment, remove_outliers
    from greenhouse_gym.reconstruction.surface import save_mesh, save_points
    from greenhouse_gym.reconstruction.walk import walk_through

    settings = ReconstructionSettings()
    opened = open_recording(recording)
    with progress("stations", len(opened)) as done:
        walk = walk_through(opened, settings, lambda i: done(i + 1), out / "walk")
    merged, outlier = merge_segment(walk, 0, settings)
    row = remove_outliers(merged, outlier)
    save_row(row, out / "row.npz")
    write_atomically(out / "report.json", report_as_json(row.report))
    save_points(row, out / "row.ply")
    mesh = make_mesh(simplify_points(row, points), faces=faces)
    save_mesh(mesh, out / "mesh.ply")
    row_pictures(merged, row, mesh, out)
    for station in row.report.stations:
        if station.reason:
            CONSOLE.print(f"station {station.station} skipped: {station.reason}", highlight=False)
    stations_used = f"{row.registered.sum()} of {len(row.registered)} stations"
    CONSOLE.print(f"{stations_used}, {len(row)} points, {len(mesh.triangles)} faces in {out}", highlight=False)


def build(
    recordings: Annotated[list[Path], typer.Argument(help="Folders of recordings, one per row.")],
    out: Out,
    name: Annotated[str, typer.Option(help="The bank's name; the folder's name by default.")] = "",
) -> None:
    """Build a bank of scenes from recordings; an interrupted build goes on where it stopped."""
    from greenhouse_gym.build import build_bank
    from greenhouse_gym.capture import open_recording

    bank = build_bank([open_recording(path) for path in recordings], out, name or out.name)
    CONSOLE.print(f"{len(bank)} scenes in {out}")


def build_shipped(out: Out = Path("scenes")) -> None:
    """Build the banks that ship with the package, from simulated recordings: ``default``, and ``mini`` for tests."""
    from greenhouse_gym.shipped import build_shipped_banks

    for bank in build_shipped_banks(out):
        CONSOLE.print(f"{bank.manifest.name}: {len(bank)} scenes in {bank.path}")
