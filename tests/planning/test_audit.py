from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from conftest import make_scene
from typer.testing import CliRunner

from greenhouse_gym.cli import app
from greenhouse_gym.errors import FileFormatError, UnknownNameError
from greenhouse_gym.planning import certify_targets
from greenhouse_gym.planning.audit import bank_faults, witness_faults
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene import bank as bank_module
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.manifest import MANIFEST


@pytest.fixture(scope="module")
def certified() -> Scene:
    scene = make_scene(5).model_copy(update={"targets": ()})
    few = scene.model_copy(update={"tomatoes": scene.tomatoes[:4]})
    return few.model_copy(update={"targets": certify_targets(few)})


@pytest.fixture
def whole(certified: Scene, tmp_path: Path) -> Path:
    return write_bank(tmp_path / "whole", [(certified, "train")], "whole").path


def faults(folder: Path, **options: Any) -> list[str]:
    bank_module._opened.cache_clear()
    return list(bank_faults(folder, **options))


def with_target(scene: Scene, **update: Any) -> Scene:
    first = next(target for target in scene.targets if target.witness)
    return scene.model_copy(update={"targets": (first.model_copy(update=update),)})


def test_a_whole_bank_has_no_faults(whole: Path) -> None:
    assert faults(whole) == []


def test_every_fault_of_a_witness_is_named(certified: Scene) -> None:
    path = next(target.witness for target in certified.targets if target.witness)
    start = tuple(get_robot("ur5e").rating_start.tolist())
    wrong = {
        "begin at the start that targets are rated from": path[::-1],
        "leaves the joints' limits": (start, (9.0, *start[1:])),
        "does not end at the tomato": (start, start),
        "touches something": (start, (start[0], 1.5, 2.9, *start[3:])),  # folded into its own cart
    }
    for expected, witness in wrong.items():
        (fault,) = witness_faults(with_target(certified, witness=witness))
        assert expected in fault
        assert certified.name in fault
    assert "no witness" in next(iter(witness_faults(with_target(certified, witness=None))))
    assert "a witness" in next(iter(witness_faults(with_target(certified, difficulty="unreachable"))))
    assert list(witness_faults(with_target(certified, robot="somebodys-arm"))) == []


def test_altered_missing_and_misdescribed_files(whole: Path) -> None:
    data = json.loads((whole / MANIFEST).read_text())
    entry = data["scenes"][0]
    entry["week"], entry["targets"]["easy"] = 9, 99
    (whole / MANIFEST).write_text(json.dumps(data))
    week, targets = faults(whole, witnesses=False)
    assert "says week 9, the scene 0" in week
    assert "says targets" in targets
    file = whole / entry["file"]
    file.write_text(file.read_text().replace('"week":0', '"week":1'))
    (altered,) = faults(whole, witnesses=False)
    assert "checksum differs" in altered
    file.unlink()
    (missing,) = faults(whole, witnesses=False)
    assert str(file) in missing
    assert "cannot be read" in missing


def test_the_manifest_itself(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError):
        faults(tmp_path / "nowhere")
    (whole / MANIFEST).write_text("{")
    with pytest.raises(FileFormatError, match="not a valid bank manifest"):
        faults(whole)


# -- the command line -------------------------------------------------------------------------------------------------

COLORLESS = {"NO_COLOR": "1", "COLUMNS": "200"}


def called(*arguments: object) -> Any:
    bank_module._opened.cache_clear()
    return CliRunner(env=COLORLESS).invoke(app, ["bank", *map(str, arguments)])


def test_info_counts(whole: Path, certified: Scene) -> None:
    result = called("info", whole)
    assert result.exit_code == 0, result.output
    counts = {name: sum(t.difficulty == name for t in certified.targets) for name in ("easy", "unreachable")}
    assert f"1 scenes of 1 recordings of 1 rows, {len(certified.targets)} targets" in result.output
    (row,) = (line for line in result.output.splitlines() if line.startswith("| all"))
    assert row.split("|")[2].strip().startswith(f"{counts['easy']} (")
    assert SceneBank.open(whole).sha256 in result.output


def test_check_ends_with_1_and_names_the_faults(whole: Path) -> None:
    assert called("check", whole).exit_code == 0
    (whole / SceneBank.open(whole).manifest.scenes[0].file).unlink()
    result = called("check", whole, "--no-witnesses")
    assert result.exit_code == 1
    assert "cannot be read" in result.output


def test_filter_and_join_write_a_new_bank(whole: Path, certified: Scene, tmp_path: Path) -> None:
    other = certified.model_copy(update={"name": "other", "targets": (Target(tomato=0, difficulty="hard"),)})
    write_bank(tmp_path / "other", [(other, "train")], "other")
    result = called("filter", whole, "--join", tmp_path / "other", "--difficulty", "hard", "--out", tmp_path / "new")
    assert result.exit_code == 0, result.output
    made = SceneBank.open(tmp_path / "new")
    assert made.names() == ["other"]
    assert made.manifest.name == "new"
    assert isinstance(called("filter", whole, "--out", whole).exception, ValueError)
    assert isinstance(called("filter", whole, "--out", tmp_path / "x", "--split", "test").exception, UnknownNameError)
    assert not (tmp_path / "x").exists()


def test_show_writes_a_page_without_a_network(whole: Path, certified: Scene, tmp_path: Path) -> None:
    nasty = certified.model_copy(
        update={
            "name": "a'&b",
            "truth": certified.compact(),
            "provenance": certified.provenance.model_copy(update={"row": "</script><b>"}),
        }
    )
    write_bank(tmp_path / "nasty", [(nasty, "train")], "nasty")
    page = tmp_path / "scene.html"
    result = called("show", tmp_path / "nasty", "--out", page)
    assert result.exit_code == 0, result.output
    text = page.read_text()
    assert "http" not in text.replace("http-equiv", "")
    assert "<b>" not in text
    assert text.count("</script>") == 2
    data = json.loads(text.split('id="data">')[1].split("</script>")[0])
    assert [layer["name"] for layer in data["layers"]] == ["reconstruction", "truth"]
    assert len(data["motions"]) == sum(target.witness is not None for target in certified.targets)
    assert len(text) < 500_000


def test_export_writes_the_scenes_asked_for(whole: Path, certified: Scene, tmp_path: Path) -> None:
    result = called("export", whole, "--format", "obj", "--out", tmp_path / "obj", "--scene", certified.name)
    assert result.exit_code == 0, result.output
    assert [path.name for path in (tmp_path / "obj").iterdir()] == [f"{certified.name}.obj"]
    assert isinstance(called("export", whole, "--format", "usd", "--out", tmp_path).exception, UnknownNameError)
