from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from row_helpers import HALF, black, from_stations, half_recording
from still_agent import STILL
from typer.main import get_command
from typer.testing import CliRunner

from greenhouse_gym import __version__
from greenhouse_gym.agents import Agent
from greenhouse_gym.capture import open_recording, simulate_recording, write_recording
from greenhouse_gym.capture.formats.own import INDEX
from greenhouse_gym.capture.image_files import read_color
from greenhouse_gym.cli import app
from greenhouse_gym.crops import grow_row
from greenhouse_gym.errors import FileFormatError, FileWriteError, GreenhouseError, UnknownNameError
from greenhouse_gym.geometry import Sphere
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
    "12-shapes-over-photograph.png",
}


ROOT = Path(__file__).parent.parent


def run(*arguments: str | Path) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


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
    assert recording.protocol == "paper"
    assert isinstance(fails("simulate", tmp_path / "x", "--style", "plum"), UnknownNameError)
    assert isinstance(fails("simulate", tmp_path / "x", "--protocol", "sideways"), UnknownNameError)
    assert "seed" in str(fails("simulate", tmp_path / "x", "--seed", "-1"))
    assert not (tmp_path / "x").exists()


# -- reconstruct ------------------------------------------------------------------------------------------------------

RESULTS = {"row.npz", "row.ply", "mesh.ply", "report.json", "report.html", "settings.toml", "9-occupancy.png"} | {
    name for name in PICTURES if name.split("-")[0] in set("12345678")
}
SMALL = ("--points", "2000", "--faces", "1500")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    three = from_stations(list(half_recording())[:3], half_recording())
    return write_recording(three, tmp_path_factory.mktemp("row") / "recording")


@pytest.fixture(scope="module")
def reconstructed(recording: Path) -> Path:
    """Files of an uninterrupted reconstruction, next to its output ``printed``."""
    out = recording.parent / "out"
    (recording.parent / "printed").write_text(run("reconstruct", recording, "--out", out, *SMALL))
    return out


def same_row(one: Path, two: Path) -> bool:
    with np.load(one / "row.npz") as a, np.load(two / "row.npz") as b:
        names = set(a.files) - {"report"}  # holds seconds
        return len(names) == 6 and all(a[name].tobytes() == b[name].tobytes() for name in names)


@pytest.mark.xdist_group("row")
def test_reconstruct_writes_cloud_mesh_report_and_pictures(reconstructed: Path) -> None:
    printed = (reconstructed.parent / "printed").read_text()
    assert "3 of 3 stations" in printed
    assert "resuming" not in printed
    assert {path.name for path in reconstructed.iterdir()} == RESULTS
    row = load_row(reconstructed / "row.npz")
    assert row.registered.all()
    assert len(json.loads((reconstructed / "report.json").read_text())["stations"]) == 3
    assert all(is_a_picture(path) for path in reconstructed.glob("*.png"))
    page = (reconstructed / "report.html").read_text()
    assert "<dd>3 of 3</dd>" in page
    assert f"<dd>{len(row):,}</dd>" in page
    assert page.count('src="data:image/') == 9


@pytest.mark.xdist_group("row")
def test_an_interrupted_reconstruction_goes_on_and_leaves_earlier_results_whole(
    recording: Path, reconstructed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C at the second station, then a disk that is full when the clouds are written, then all is well."""
    old = {
        "row.npz",
        "row.ply",
        "row-2.npz",
        "row-3.ply",
        "report.html",
        "2-foreground.png",
        "notes.txt",
        "row-old.ply",
    }
    for name in old:
        (tmp_path / name).write_text("old")

    def untouched() -> bool:
        there = {path.name for path in tmp_path.iterdir()}
        return there == old | {"registration"} and all((tmp_path / name).read_text() == "old" for name in old)

    @contextmanager
    def interrupted(what: str, total: int) -> Iterator[Callable[[int], None]]:
        def done(count: int) -> None:
            if count == 2:
                raise KeyboardInterrupt

        yield done

    def full(path: Path, content: str) -> None:
        raise FileWriteError(path, OSError(28, "No space left on device"))

    with monkeypatch.context() as patched:
        patched.setattr("greenhouse_gym.cli.reconstruction_commands.progress", interrupted)
        result = CliRunner().invoke(app, ["reconstruct", str(recording), "--out", str(tmp_path)])
    assert result.exit_code == 130
    assert f"2 of 3 stations are kept in {tmp_path / 'registration'}; repeat the command to resume" in result.output
    assert untouched()

    with monkeypatch.context() as patched:
        patched.setattr("greenhouse_gym.reporting.report_page.write_atomically", full)
        assert "No space left" in str(fails("reconstruct", recording, "--out", tmp_path, *SMALL))
    assert untouched()

    assert "resuming after station 2\n" in run("reconstruct", recording, "--out", tmp_path, *SMALL)
    assert {path.name for path in tmp_path.iterdir()} == RESULTS | {"notes.txt", "row-old.ply"}
    assert same_row(tmp_path, reconstructed)


@pytest.mark.xdist_group("row")
def test_a_gap_in_the_row_makes_two_segments(tmp_path: Path) -> None:
    """And a name that is markup, for browsers and for the terminal, is shown as it is."""
    other = simulate_recording(grow_row(seed=5, length=0.3), seed=5, rig=HALF)
    stations = [*list(half_recording())[:3], *list(other)[:3]]
    hostile = replace(from_stations(stations, half_recording()), name="<script>alert(1)</script>[/]")
    write_recording(hostile, tmp_path / "recording")
    out = tmp_path / "[red]out"
    printed = run("reconstruct", tmp_path / "recording", "--out", out, *SMALL, "--method", "alpha_shape")
    assert "6 of 6 stations" in printed
    assert "station 3 begins a new segment: " in printed
    assert "warning: the row splits into 2 segments" in printed
    assert str(out) in printed
    assert {path.name for path in out.iterdir()} == RESULTS | {"row-2.npz", "row-2.ply"}
    first, second = load_row(out / "row.npz"), load_row(out / "row-2.npz")
    assert first.registered.tolist() == [True] * 3 + [False] * 3
    assert second.registered.tolist() == [False] * 3 + [True] * 3
    page = (out / "report.html").read_text()
    assert "<script" not in page
    assert "<h1>&lt;script&gt;alert(1)&lt;/script&gt;[/]</h1>" in page
    assert '<p class="warning">the row splits into 2 segments' in page
    assert "row-2.npz, row-2.ply" in page


@pytest.mark.xdist_group("row")
def test_stations_without_neighbors_have_no_pictures_of_a_registration(tmp_path: Path) -> None:
    first, second = half_recording()[0], half_recording()[1]
    write_recording(from_stations([first, black(first), second], half_recording()), tmp_path / "recording")
    printed = run("reconstruct", tmp_path / "recording", "--out", tmp_path / "out", *SMALL)
    assert "2 of 3 stations" in printed
    assert "station 1 skipped: camera 'middle': 0.0% foreground" in printed
    assert {path.name for path in tmp_path.glob("out/*.png")} == {name for name in RESULTS if name[0] in "56789"}


def test_reconstruct_checks_what_it_is_given(tmp_path: Path) -> None:
    stations = [black(station) for station in half_recording()]
    folder, out = write_recording(from_stations(stations, half_recording()), tmp_path / "recording"), tmp_path / "out"
    assert "ball_pivoting" in str(fails("reconstruct", folder, "--out", out, "--method", "marching_cubes"))
    assert not out.exists()
    assert "0 of 5 stations registered" in str(fails("reconstruct", folder, "--out", out))
    assert not list(out.iterdir())  # or mended images would not be looked at
    (out / "registration").mkdir()
    (out / "registration" / "thesis.txt").write_text("mine")
    assert "not the work folder of a reconstruction" in str(fails("reconstruct", folder, "--out", out))
    assert (out / "registration" / "thesis.txt").read_text() == "mine"


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
        [*plan_to(bank), "--set", "range=0.5", "--picture", str(picture)],
    )
    assert result.exit_code == 0, result.output
    row = next(line for line in result.output.splitlines() if line.startswith("| RRTConnect"))
    assert row.split("|")[2].strip() == "solved"
    assert is_a_picture(picture)


def plan_to(bank: SceneBank) -> list[str]:
    return ["plan", "--scene", bank.names()[0], "--target", "4", "--bank", str(bank.path)]


def test_plan_with_all_planners_prints_a_table(bank: SceneBank) -> None:
    from greenhouse_gym.planning import PLANNERS

    result = CliRunner().invoke(app, [*plan_to(bank), "--all", "--time-limit", "0.1"])
    assert result.exit_code == 0, result.output
    rows = [line.split("|")[1].strip() for line in result.output.splitlines() if line.startswith("|")]
    assert rows[2:] == list(PLANNERS)


def test_plan_names_settings_that_are_none(bank: SceneBank) -> None:
    assert "Did you mean 'range'" in str(fails(*plan_to(bank), "--set", "rang=0.5"))
    assert "range must be a finite number" in str(fails(*plan_to(bank), "--set", "range=far"))
    assert "--all" in str(fails(*plan_to(bank), "--set", "range=0.5", "--all"))


def test_plan_to_what_cannot_be_reached_exits_with_2(bank: SceneBank, tmp_path: Path) -> None:
    from greenhouse_gym.crops.parts import Tomato
    from greenhouse_gym.scene import Provenance, Scene
    from greenhouse_gym.scene.bank import write_bank

    far = Scene(name="far", tomatoes=(Tomato(Sphere([5, 0, 1], 0.03), truss=0),), provenance=Provenance(row="r"))
    folder = write_bank(tmp_path / "bank", [(far, "test")], name="far").path
    result = CliRunner().invoke(app, ["plan", "--scene", "far", "--target", "0", "--bank", str(folder)])
    assert result.exit_code == 2, result.output
    assert "no_goal" in result.output
    error = fails("plan", "--scene", "far", "--target", "0", "--bank", folder, "--planner", "RRTconnect")
    assert "Did you mean 'RRTConnect'" in str(error)


def test_an_expected_error_is_one_line_and_status_1(tmp_path: Path) -> None:
    """Also a long one, and one with brackets, as paths and extras have them."""
    folder = tmp_path / f"[bold]{'very-' * 20}long[" / "[/]"
    folder.mkdir(parents=True)
    done = command("reconstruct", folder, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stderr.startswith(f"error: {folder}: not a recording of a known format (greenhouse: {INDEX}")


def test_usage_errors_and_help() -> None:
    assert command("mount").returncode == 2
    shown = CliRunner().invoke(app, ["--help"]).output
    for name in ("simulate", "reconstruct", "build", "plan", "train", "compare", "render", "demo"):
        assert name in shown


def test_commands_are_listed_in_groups() -> None:
    shown = CliRunner(env={"COLUMNS": "80", "TERM": "dumb"}).invoke(app, ["--help"]).output
    panels = ("Options", "Learning", "Planning", "From recordings to scenes", "Banks and policies", "Help")
    assert [shown.index(f"─ {panel} ─") for panel in panels] == sorted(shown.index(f"─ {panel} ─") for panel in panels)
    assert "build-shipped" not in shown
    assert "--install-completion" in shown
    assert run("--version").split() == ["greenhouse-gym", __version__]


def test_every_help_page_fits_and_has_examples_of_its_own() -> None:
    """Help pages of 80 columns: no text of another command, and no line that is cut."""
    group = get_command(app)
    runner = CliRunner(env={"COLUMNS": "80", "TERM": "dumb"})
    for name in group.commands:  # type: ignore[attr-defined]
        shown = runner.invoke(app, [name, "--help"]).output
        assert max(map(len, shown.splitlines())) <= 80, name
        assert "…" not in shown, name
        assert ("voxel" in shown) == (name in ("reconstruct", "shapes", "build")), name


def test_names_are_listed() -> None:
    from greenhouse_gym.planning import PLANNERS

    listed = {line.split("|")[1].strip() for line in run("list").splitlines() if line.startswith("|")}
    assert {"random", "ppo-ur5e", "default", "mini", "ur5e", "iiwa14", *PLANNERS} <= listed
    assert "RRTConnect" not in run("list", "policies")
    assert run("policy", "list") == run("list", "policies").rstrip() + "\n"
    assert "Did you mean 'banks'" in str(fails("list", "bank"))


def test_a_file_of_own_code_needs_a_name() -> None:
    error = str(fails("compare", f"{ROOT}/examples/own_agent.py", "--bank", "mini"))
    assert error.endswith(f"such as {ROOT}/examples/own_agent.py:ReachForIt")
    error = str(fails("compare", "random", "--task", f"{ROOT}/examples/own_task.py", "--bank", "mini"))
    assert "own_task.py:LookAtTomato" in error


def test_entries_are_written_into_the_repository_or_a_given_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for arguments in (["submit", "random", "--episodes", "1"], ["leaderboard"]):
        assert "no benchmarks/leaderboard in" in str(fails(*arguments))
    assert not list(tmp_path.iterdir())


def test_other_commands_check_their_names(bank: SceneBank, tmp_path: Path) -> None:
    assert "ppo" in str(fails("train", "dqn", "--bank", bank.path, "--out", tmp_path))
    assert isinstance(fails("compare", "random", "--bank", "no-such-bank"), UnknownNameError)
    assert isinstance(fails("build", tmp_path, "--out", tmp_path / "bank"), FileFormatError)


@pytest.mark.parametrize("command", ["reconstruct", "build", "import", "calibrate"])
@pytest.mark.parametrize("options", [(), ("--format", "open3d")])
def test_a_missing_recording_is_named(tmp_path: Path, command: str, options: tuple[str, ...]) -> None:
    missing = tmp_path / "Gewächshaus 7"
    error = fails(command, missing, "--out", tmp_path / "out", *options)
    assert str(error) == f"{missing}: no such folder or file"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("compare", "{}/policy.json"), "policy.json: there is no such file; expected a policy's description"),
        (("compare", "{}/mine.py:Mine"), "mine.py: there is no such file; expected Python code"),
        (("mount", "{}/arm.xml", "--out", "{}/out.xml"), "arm.xml: no such file; expected an arm's MJCF file"),
        (("compare", STILL, "--robot", "{}/arm.xml", "--bank", "mini"), "arm.xml: no such file"),
        (("leaderboard", "{}"), "holds no entry; `greenhouse-gym submit` writes one"),
        (("compare", STILL, "--bank", "mini", "--timeout", "-1"), "timeout must be a positive number of seconds"),
    ],
)
def test_missing_files_are_named(tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    assert message in str(fails(*(argument.format(tmp_path) for argument in arguments)))


def test_weeks_are_listed_as_numbers(tmp_path: Path) -> None:
    error = fails("bank", "filter", "default", "--out", tmp_path / "out", "--week", "99")
    assert isinstance(error, UnknownNameError)
    assert list(error.choices) == sorted(error.choices, key=int)


def test_a_group_of_commands_alone_prints_its_help() -> None:
    for group in ((), ("bank",)):
        assert "COMMAND [ARGS]" in CliRunner().invoke(app, group).output


def test_paths_are_printed_as_they_are(tmp_path: Path) -> None:
    folder = tmp_path / "[bold] Gewächshaus 7"
    assert f"in {folder / 'scene.html'}\n" in run("bank", "show", "mini", "--out", folder / "scene.html")


def test_negative_seeds_are_refused(bank: SceneBank, tmp_path: Path) -> None:
    for arguments in (("compare", STILL), ("train", "ppo", "--out", tmp_path)):
        error = str(fails(*arguments, "--bank", bank.path, "--seed", "-1"))
        assert error.startswith("seed")
        assert "got -1" in error


def test_compare_prints_a_table(bank: SceneBank) -> None:
    printed = run("compare", "random", STILL, "--bank", bank.path, "--split", "test", "--episodes", "2")
    assert "random" in printed
    assert "still" in printed


def test_compare_takes_agents_of_every_kind(bank: SceneBank) -> None:
    own = (f"{ROOT}/examples/own_agent.py:ReachForIt", STILL)
    arguments = ("--bank", bank.path, "--episodes", "2", "--robot", "ur5e", "--difficulty", "easy,medium")
    printed = run("compare", "random", *own, "--num-envs", "2", *arguments)
    tables = [part.splitlines() for part in printed.split("\n\n")[1:3]]
    assert all(len(line) <= 80 for table in tables for line in table)
    names = [[line.split("|")[1].strip() for line in table[2:]] for table in tables]
    assert names == [["random", "reach for it", "still"]] * 2
    assert printed.count("McNemar") == 1, "one line on all pairs"
    assert "nan" not in printed
    message = str(fails("compare", "RRTConect", *arguments))
    assert "unknown agent 'RRTConect'. Did you mean 'RRTConnect'?" in message
    assert all(name in message for name in ("straight-line", "ppo-ur5e", "file.py:Class"))
    assert "iiwa14" in str(fails("compare", "ppo-ur5e", "--bank", bank.path, "--robot", "iiwa14"))
    assert "'simple'" in str(fails("compare", STILL, "--bank", bank.path, "--difficulty", "simple"))


def test_compare_on_tracks() -> None:
    arguments = ("--bank", "mini", "--split", "validation", "--episodes", "1")
    printed = run("compare", STILL, *arguments, "--track", "truth,moved")
    tracks = [line for line in printed.splitlines() if line.startswith("track")]
    assert [line.split(":")[0] for line in tracks] == ["track truth", "track moved"]
    assert len([line for line in printed.splitlines() if line.startswith("| still ")]) == 4
    assert "reconstruction, truth, moved" in str(fails("compare", STILL, "--track", "rumor"))


@pytest.mark.timeout(600)
def test_the_demo_runs_whole(tmp_path: Path) -> None:
    done = command("demo", "--quick", "--out", tmp_path / "demo")
    assert done.returncode == 0, done.stdout + done.stderr
    out = tmp_path / "demo"
    assert {path.name for path in out.glob("*.png")} == PICTURES
    for path in out.glob("*.png"):
        assert is_a_picture(path), path.name
    results = json.loads((out / "results.json").read_text())
    assert results["stations"] == results["stations_registered"] == 4
    assert results["targets_with_goal"] >= 3
    assert results["targets_reached"] >= 0.9 * results["targets_with_goal"]
    assert results["plans_followed_in_truth"] + results["refused"] == 3
    assert results["held_in_truth"] <= results["plans_followed_in_truth"]
    assert results["cloud_to_truth_mean"] < 0.004
    assert results["drift"] < 0.03
    assert results["visible_tomatoes_found"] >= 0.75 * results["visible_tomatoes"]
    assert results["simplified_points"] == pytest.approx(10_000, rel=0.05)
    assert 0 < results["faces"] <= 18_000
    assert len(SceneBank.open(out / "bank")) == results["scenes"] == 2
    assert len(open_recording(out / "recording")) == 4
    assert (out / "comparison.md").read_text().count("|") > 20
    assert (out / "ppo" / "policy.json").is_file()
    assert (out / "13-policy.mp4").stat().st_size > 0


# -- settings and formats ---------------------------------------------------------------------------------------------


def test_formats_are_listed() -> None:
    printed = run("formats").splitlines()
    assert [line.split(":")[0] for line in printed[:3]] == ["greenhouse", "calibrated", "open3d"]


@pytest.mark.parametrize(
    ("command", "setting"),
    [
        ("reconstruct", "voxel"), ("build", "shapes"), ("train", "rollout_steps"), ("train bc-then-ppo", "imitation"),
        ("train sac-her", "hindsight_goals"),
    ],
)  # fmt: skip
def test_settings_are_printed_as_a_file_to_begin_from(command: str, setting: str) -> None:
    printed = run(*command.split(), "--print-settings")
    assert setting in tomllib.loads(printed)
    assert printed.count("# ") > 12


def test_misspelt_settings_list_the_choices(recording: Path, tmp_path: Path) -> None:
    out = ["--out", tmp_path / "out"]
    assert "Did you mean 'voxel'" in str(fails("reconstruct", recording, *out, "--set", "voxl=0.004"))
    assert "Did you mean 'shapes.voxel'" in str(fails("build", recording, *out, "--set", "shapes.voxl=0.004"))
    (tmp_path / "s.toml").write_text("total_step = 5")
    error = str(fails("train", "ppo", "--settings", tmp_path / "s.toml", *out))
    assert "s.toml: unknown setting 'total_step'. Did you mean 'total_steps'?" in error
    assert "recording format 'rosbag'" in str(fails("build", recording, *out, "--format", "rosbag"))
    assert not (tmp_path / "out").exists()


@pytest.mark.xdist_group("row")
def test_resolved_settings_lie_beside_the_results(recording: Path, reconstructed: Path, tmp_path: Path) -> None:
    assert "voxel = 0.002\n" in (reconstructed / "settings.toml").read_text()
    settings = ["--settings", reconstructed / "settings.toml", "--set", "voxel=0.01", "--set", "calibration_stations=0"]
    run("reconstruct", recording, "--out", tmp_path, *SMALL, *settings)
    assert "voxel = 0.01\n" in (tmp_path / "settings.toml").read_text()
    assert len(load_row(tmp_path / "row.npz")) < 0.2 * len(load_row(reconstructed / "row.npz"))


def test_a_build_writes_its_settings(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from greenhouse_gym import build
    from greenhouse_gym.build import bank_builder
    from greenhouse_gym.build.scenes import BuildSettings
    from greenhouse_gym.common.settings_files import resolve

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(bank_builder, "reconstruct_row", stop)
    result = CliRunner().invoke(app, ["build", str(recording), "--out", str(tmp_path / "bank")])
    assert result.exit_code == 130
    assert "repeat the command to resume" in result.output
    given: list[object] = []
    monkeypatch.setattr(build, "build_bank", lambda *_, settings, **__: given.append(settings) or [])
    run("build", recording, "--out", tmp_path / "bank", "--set", "shapes.voxel=0.004", "--set", "width=1.5")
    (settings,) = given
    assert isinstance(settings, BuildSettings)
    assert (settings.width, settings.shapes.voxel) == (1.5, 0.004)
    assert resolve(BuildSettings(), tmp_path / "bank" / "settings.toml") == settings


@pytest.mark.parametrize("name", ["reconstruct", "demo"])
def test_one_process_at_a_time_and_no_file_for_a_folder(recording: Path, tmp_path: Path, name: str) -> None:
    from greenhouse_gym.common.files import exclusive

    arguments = [recording] if name == "reconstruct" else ["--quick"]
    (tmp_path / "file").touch()
    assert "file: cannot be written" in str(fails(name, *arguments, "--out", tmp_path / "file"))
    with exclusive(tmp_path / "out"):
        assert "another process is at work" in str(fails(name, *arguments, "--out", tmp_path / "out"))
    assert list((tmp_path / "out").iterdir()) == []


def test_demonstrations_print_how_to_load_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from greenhouse_gym.agents import demonstrations

    asked: list[dict[str, object]] = []

    def record(agent: Agent, out: Path, episodes: int, seed: int, split: str, **options: object) -> str:
        asked.append({"agent": agent.name, "episodes": episodes, "split": split} | options)
        return "tomato-reach/still-v0"

    monkeypatch.setattr(demonstrations, "record_demonstrations", record)
    shown = run("demonstrations", STILL, "--episodes", "3", "--bank", "mini", "--out", tmp_path)
    assert f"MINARI_DATASETS_PATH={tmp_path} and minari.load_dataset('tomato-reach/still-v0')" in shown
    (asked_for,) = asked
    del asked_for["on_progress"]
    assert asked_for == {"agent": "still", "episodes": 3, "split": "train", "bank": "mini", "observation": "state"}


def test_watch_films_what_it_is_asked_for(bank: SceneBank, tmp_path: Path) -> None:
    out, scene = tmp_path / "a.gif", bank.names("train")[0]
    where = ["--bank", bank.path, "--split", "train", "--scene", scene, "--target", "2", "--difficulty", "easy,hard"]
    printed = run("watch", STILL, *where, "--out", out, "--episodes", "2", "--fps", "1", "--size", "64x48")
    lines = printed.splitlines()
    assert len(lines) == 3
    assert all(line.startswith(f"still: {scene}, tomato 2 (") and ": ended " in line for line in lines[:2])
    assert lines[2] == f"2 episodes in {out}"
    assert out.read_bytes()[:3] == b"GIF"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--out", "a.avi"), "a.avi: expected a file that ends in .mp4 or .gif"),
        (("--target", "1"), "scene"),
        (("--track", "rumor"), "moved"),
        (("--size", "640"), "--size: expected two whole numbers such as 640x480, got '640'"),
        (("--fps", "21"), "at most 20"),
    ],
)
def test_watch_names_what_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in str(fails("watch", "random", "--bank", "mini", "--out", "b.gif", *arguments))
    assert not list(tmp_path.iterdir())


def test_no_finished_part_leaves_the_shipped_banks_as_they_are(tmp_path: Path) -> None:
    error = fails("build-shipped", "--finished-only", "--parts", tmp_path / "parts", "--out", tmp_path / "out")
    assert str(error) == f"{tmp_path / 'parts'}: holds no finished part of the shipped banks"
    assert not (tmp_path / "out").exists()


def test_training_rows_keep_away_from_shipped_seeds(tmp_path: Path) -> None:
    error = fails("bank", "grow", "--out", tmp_path / "out", "--seed", 2004)
    assert str(error) == "seed must be 10000 or more: smaller ones are of shipped and held-out rows, got 2004"
    assert not (tmp_path / "out").exists()


def test_bank_info_keeps_unknown_styles_and_sources_apart(bank: SceneBank) -> None:
    printed = run("bank", "info", bank.path)
    counts = {line.split("|")[1].strip(): line.split("|")[2:] for line in printed.splitlines() if line.startswith("|")}
    assert counts["unknown style"] == counts["unknown source"] == counts["all"]
    assert "nan" not in printed
    assert max(len(line) for line in printed.splitlines() if line.startswith("|")) <= 80
