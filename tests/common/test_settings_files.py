from __future__ import annotations

import json
import tomllib
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import pytest

from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.common.settings_files import as_toml, resolve
from greenhouse_gym.errors import FileFormatError, GreenhouseError, InvalidValueError, UnknownNameError
from greenhouse_gym.reconstruction import ReconstructionSettings
from greenhouse_gym.shapes import ShapeSettings


@dataclass(frozen=True)
class Described:
    """Settings.

    Attributes:
        speed: How fast, and
            on which road.
        name: Of the car.
    """

    speed: float = 2.0
    name: str = "car"
    wheels: int = 4  # on the road
    spare: int | None = None


@pytest.mark.parametrize(
    ("assignments", "expected"),
    [
        (["speed=3"], Described(speed=3.0)),
        (["speed = 1e-3", "name=bus"], Described(speed=0.001, name="bus")),
        (['name="a = b"', "spare=1"], Described(name="a = b", spare=1)),
        (["wheels=6", "wheels=8"], Described(wheels=8)),
    ],
)
def test_assignments(assignments: list[str], expected: Described) -> None:
    assert resolve(Described(), assignments=assignments) == expected


def test_inner_fields_and_tuples() -> None:
    settings = resolve(BuildSettings(), assignments=["shapes.voxel=0.004", "width=2", "reconstruction.links=[2]"])
    shapes = replace(ShapeSettings(), voxel=0.004)
    assert settings == BuildSettings(width=2.0, shapes=shapes, reconstruction=ReconstructionSettings(links=(2,)))


@pytest.mark.parametrize(
    ("name", "content"),
    [("s.toml", "width = 2\n[shapes]\nvoxel = 0.004\n"), ("s.json", '{"width": 2, "shapes": {"voxel": 0.004}}')],
)
def test_files(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    settings = resolve(BuildSettings(), tmp_path / name, ["shapes.voxel=0.005"])
    assert (settings.width, settings.shapes.voxel) == (2.0, 0.005)
    assert settings.shapes.truss_spread == ShapeSettings().truss_spread


@pytest.mark.parametrize(
    ("assignment", "error", "problem"),
    [
        ("shapes.voxl=1", UnknownNameError, r"setting 'shapes\.voxl'\. Did you mean 'shapes\.voxel'\?"),
        ("colour=1", UnknownNameError, "Choices: spacing, width"),
        ("width=wide", InvalidValueError, r"setting width: .*number.*'wide'"),
        ("shapes.radii=[1]", InvalidValueError, r"shapes\.radii"),
        ("shapes=1", InvalidValueError, "shapes"),
        ("width", InvalidValueError, r"expected a field and its value, as shapes\.voxel=0\.004"),
        ("=1", InvalidValueError, "expected a field and its value"),
        ("robot.name=1", InvalidValueError, "robot"),
    ],
)
def test_what_is_no_assignment(assignment: str, error: type[GreenhouseError], problem: str) -> None:
    with pytest.raises(error, match=problem):
        resolve(BuildSettings(), assignments=[assignment])


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("width = ", "not a valid file of settings"),
        ("voxel = 0.1", r"unknown setting 'voxel'.*Choices: spacing"),
        ("[shapes]\nvoxl = 0.1", r"Did you mean 'shapes\.voxel'"),
        ("width = 'wide'", "setting width"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, content: str, problem: str) -> None:
    path = tmp_path / "s.toml"
    path.write_text(content)
    with pytest.raises(FileFormatError, match=rf"s\.toml: .*{problem}"):
        resolve(BuildSettings(), path)
    with pytest.raises(FileFormatError, match="cannot be read"):
        resolve(BuildSettings(), tmp_path / "none.json")
    (tmp_path / "list.json").write_text("[1]")
    with pytest.raises(FileFormatError, match=r"list\.json: .*expected fields with their values"):
        resolve(BuildSettings(), tmp_path / "list.json")


@pytest.mark.parametrize("comments", [True, False])
def test_what_is_written_is_read_again(tmp_path: Path, comments: bool) -> None:
    settings = resolve(BuildSettings(), assignments=["reconstruction.voxel=0.003", "width=1.5"])
    path = tmp_path / "settings.toml"
    path.write_text(as_toml(settings, comments))
    assert resolve(BuildSettings(), path) == settings
    given = {name: value for name, value in asdict(settings).items() if value is not None}  # TOML has no null
    assert json.dumps(tomllib.loads(path.read_text()), sort_keys=True) == json.dumps(given, sort_keys=True)


def test_every_field_is_shown_with_what_its_class_says_of_it() -> None:
    assert as_toml(Described(), comments=True).splitlines() == [
        "# Settings.",
        "speed = 2.0  # How fast, and on which road.",
        'name = "car"  # Of the car.',
        "wheels = 4  # on the road",
        "# spare =",
    ]
    shown = as_toml(BuildSettings(), comments=True)
    assert "foreground = 0.6  # m, the paper's cut" in shown
    assert "spacing = 0.5  # between the placements of two scenes of a row" in shown
    assert (
        "[shapes]\n# Settings for extracting shapes from a cloud. Lengths are in metres.\nvoxel = 0.003  # voxel"
        in shown
    )


def test_null_stands_for_none_and_is_kept(tmp_path: Path) -> None:
    chosen = resolve(BuildSettings(), None, ["shapes.small_radii=null", "max_targets=null"])
    assert chosen.shapes.small_radii is None
    assert chosen.max_targets is None
    file = tmp_path / "settings.toml"
    file.write_text(as_toml(chosen))
    assert resolve(BuildSettings(), file) == chosen
    assert "targets" not in file.read_text()  # as it is by default
    with pytest.raises(InvalidValueError, match=r"setting shapes\.voxel: Input should be a valid number"):
        resolve(BuildSettings(), None, ["shapes.voxel=null"])


def test_what_a_class_says_of_its_values_is_the_message() -> None:
    with pytest.raises(InvalidValueError) as refused:
        resolve(BuildSettings(), None, ["shapes.voxel=0"])
    assert str(refused.value) == "setting shapes: voxel: Input should be greater than 0, got 0.0"
