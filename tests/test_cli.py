from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from row_helpers import half_recording
from typer.testing import CliRunner

from greenhouse_gym.capture import open_recording, write_recording
from greenhouse_gym.capture.images import read_color
from greenhouse_gym.capture.recordings import INDEX
from greenhouse_gym.cli import app
from greenhouse_gym.errors import FileFormatError, GreenhouseError, UnknownNameError
from greenhouse_gym.reconstruction import load_row
from greenhouse_gym.scene import SceneBank

PICTURES = {
    "0-overview.png",
    "1-two-images.png",
    "2-foreground.png",
    "3-silhouettes-at-best-shift.png",
    "4-before-and-after-icp.png",
    "5-stations-before-outlier-removal.png",
    "6-stations-after-outlier-removal.png",
    "7-row.png",
    "8-mesh.png",
    "9-arm-at-start.png",
    "10-arm-at-target.png",
    "11-training-curve.png",
}


def run(*arguments: str | Path) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def fails(*arguments: str | Path) -> GreenhouseError:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert isinstance(result.exception, GreenhouseError), result.output
    return result.exception


def command(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """The installed command, as a shell would start it."""
    code = "import sys; sys.argv[0] = 'greenhouse-gym'; from greenhouse_gym.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=False
    )


def is_a_picture(path: Path) -> bool:
    image = read_color(path)
    return bool(min(image.shape[:2]) > 60 and image.std() > 5)


def test_simulate_writes_a_recording_once(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    run("simulate", folder, "--seed", "4", "--length", "0.1", "--week", "1", "--style", "cherry")
    recording = open_recording(folder)
    assert len(recording) == 1
    assert recording[0].world_from_station is not None
    assert isinstance(fails("simulate", folder, "--length", "0.1"), FileFormatError)
    assert isinstance(fails("simulate", tmp_path / "x", "--style", "plum"), UnknownNameError)
    assert "seed" in str(fails("simulate", tmp_path / "x", "--seed", "-1"))
    assert not (tmp_path / "x").exists()


@pytest.mark.xdist_group("row")
def test_reconstruct_writes_cloud_mesh_report_and_pictures(tmp_path: Path) -> None:
    write_recording(half_recording(), tmp_path / "recording")
    out = tmp_path / "out"
    printed = run("reconstruct", tmp_path / "recording", "--out", out, "--points", "2000", "--faces", "1500")
    assert "5 of 5 stations" in printed
    assert {path.name for path in out.iterdir()} == {"row.npz", "row.ply", "mesh.ply", "report.json"} | {
        name for name in PICTURES if name[0] in "5678"
    }
    row = load_row(out / "row.npz")
    assert row.registered.all()
    assert len(json.loads((out / "report.json").read_text())["stations"]) == 5
    assert all(is_a_picture(path) for path in out.glob("*.png"))


def test_render_draws_a_scene(bank: SceneBank, tmp_path: Path) -> None:
    run(
        "render",
        "--scene",
        bank.names()[0],
        "--bank",
        bank.path,
        "--target",
        "1",
        "--out",
        tmp_path / "s" / "scene.png",
    )
    assert is_a_picture(tmp_path / "s" / "scene.png")
    assert isinstance(
        fails("render", "--scene", "none", "--bank", bank.path, "--out", tmp_path / "x.png"), UnknownNameError
    )
    error = fails(
        "render", "--scene", bank.names()[0], "--bank", bank.path, "--target", "99", "--out", tmp_path / "x.png"
    )
    assert "99" in str(error)


def test_plan_finds_a_path_and_draws_it(bank: SceneBank, tmp_path: Path) -> None:
    picture = tmp_path / "path.png"
    result = CliRunner().invoke(
        app,
        ["plan", "--scene", bank.names()[0], "--target", "4", "--bank", str(bank.path), "--picture", str(picture)],
    )
    assert result.exit_code == 0, result.output
    assert "RRTConnect: solved" in result.output
    assert is_a_picture(picture)


def test_plan_to_what_cannot_be_reached_exits_with_2(bank: SceneBank, tmp_path: Path) -> None:
    from greenhouse_gym.crop import Tomato
    from greenhouse_gym.scene import Provenance, Scene
    from greenhouse_gym.scene.bank import write_bank

    far = Scene(name="far", tomatoes=(Tomato([5, 0, 1], 0.03, truss=0),), provenance=Provenance(row="r"))
    folder = write_bank(tmp_path / "bank", [(far, "test")], name="far").path
    result = CliRunner().invoke(app, ["plan", "--scene", "far", "--target", "0", "--bank", str(folder)])
    assert result.exit_code == 2, result.output
    assert "no_goal" in result.output
    error = fails("plan", "--scene", "far", "--target", "0", "--bank", folder, "--planner", "RRTconnect")
    assert "Did you mean 'RRTConnect'" in str(error)


def test_an_expected_error_is_one_line_and_status_1(tmp_path: Path) -> None:
    """Also a long one, and one with brackets, as paths and extras have them."""
    folder = tmp_path / f"[bold]{'very-' * 20}long[" / "[/]"
    done = command("reconstruct", folder, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stderr.startswith(f"error: {folder}: not a recording: expected {INDEX}")


def test_usage_errors_and_help() -> None:
    assert command("plan").returncode == 2
    shown = CliRunner().invoke(app, ["--help"]).output
    for name in ("simulate", "reconstruct", "build", "plan", "train", "compare", "render", "demo"):
        assert name in shown


def test_other_commands_check_their_names(bank: SceneBank, tmp_path: Path) -> None:
    assert "ppo" in str(fails("train", "dqn", "--bank", bank.path, "--out", tmp_path))
    assert isinstance(fails("compare", "random", "--bank", "no-such-bank"), UnknownNameError)
    assert isinstance(fails("build", tmp_path, "--out", tmp_path / "bank"), FileFormatError)


def test_compare_prints_a_table(bank: SceneBank) -> None:
    printed = run("compare", "random", "still", "--bank", bank.path, "--split", "test", "--episodes", "2")
    assert "random" in printed
    assert "still" in printed


@pytest.mark.timeout(600)
def test_the_demo_runs_whole(tmp_path: Path) -> None:
    done = command("demo", "--quick", "--out", tmp_path / "demo")
    assert done.returncode == 0, done.stdout + done.stderr
    out = tmp_path / "demo"
    assert {path.name for path in out.glob("*.png")} == PICTURES
    for path in out.glob("*.png"):
        assert is_a_picture(path), path.name
    results = json.loads((out / "results.json").read_text())
    assert results["stations"] == results["stations_registered"] == 6
    assert results["targets_with_goal"] >= 3
    assert results["targets_reached"] >= 0.9 * results["targets_with_goal"]
    assert results["cloud_to_truth_mean"] < 0.004
    assert results["drift"] < 0.03
    assert results["visible_tomatoes_found"] >= 0.75 * results["visible_tomatoes"]
    assert results["simplified_points"] == pytest.approx(10_000, rel=0.05)
    assert 0 < results["faces"] <= 18_000
    assert len(SceneBank.open(out / "bank")) == results["scenes"] == 2
    assert len(open_recording(out / "recording")) == 6
    assert (out / "comparison.md").read_text().count("|") > 20
    assert (out / "ppo" / "policy.json").is_file()
