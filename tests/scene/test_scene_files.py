from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Box, Capsule, Ellipsoid, Sphere, rotation_about
from greenhouse_gym.scene import ArmPlacement, Provenance, Scene, Shapes, Target


@pytest.fixture
def full() -> Scene:
    """A scene with something in every field."""
    tomatoes = (
        Tomato(Sphere([0.1, 0.2, 1.0 / 3.0], 0.03), truss=2, ripeness=0.7),
        Tomato(Sphere([0.1, 0.3, 1.2], 0.03), truss=2),
    )
    return Scene(
        name="full",
        tomatoes=tomatoes,
        stems=(Stem([0.5, 0, 0], [0.5, 0.01, 2], 0.006, kind="main"), Stem([0, 0, 0], [0, 1, 0], 0.02, kind="pipe")),
        clutter=(
            Sphere([0, 0, 0.3], 0.1),
            Capsule([0, 0, 0], [0, 0.1, 0.2], 0.01),
            Box([0.1, 0.2, 0.3], [0.1, 0.2, 0.3], [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        ),
        placement=ArmPlacement(position=[0.1, -0.2, 0.0], yaw=0.3, shoulder_height=1.2),
        targets=(
            Target(tomato=1, difficulty="hard", witness=((0.0, 0.1), (0.2, 1.0 / 7.0))),
            Target(tomato=0, difficulty="unreachable", robot="iiwa14"),
        ),
        provenance=Provenance(
            row="r", station=3, week=1, recording="rec", recording_sha256="ab", settings={"a": [1, {"b": 2.5}]},
            package_version="0.1.0",
        ),
        truth=Shapes(tomatoes=tomatoes[:1]),
    )  # fmt: skip


def saved(scene: Scene, tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    path = scene.save(tmp_path / "scene.json")
    return path, json.loads(path.read_text())


def test_every_field_survives_the_round_trip(full: Scene, tmp_path: Path) -> None:
    path, data = saved(full, tmp_path)
    again = Scene.load(path)
    assert again.model_dump(mode="json") == full.model_dump(mode="json") == data
    assert [type(shape) for shape in again.obstacles] == [type(shape) for shape in full.obstacles]
    for a, b in zip(again.obstacles, full.obstacles, strict=True):
        for name, value in vars(b).items():
            np.testing.assert_array_equal(getattr(a, name), value)
    assert again.targets == full.targets
    assert again.provenance == full.provenance
    assert again.truth is not None
    assert again.save(tmp_path / "again.json").read_bytes() == path.read_bytes()


def test_the_least_a_scene_file_holds(tmp_path: Path) -> None:
    path = tmp_path / "least.json"
    path.write_text('{"name": "least", "provenance": {"row": "r"}}')
    scene = Scene.load(path)
    assert scene.obstacles == ()
    assert scene.targets == ()
    assert scene.truth is None
    np.testing.assert_array_equal(scene.placement.position, 0.0)
    assert scene.placement.shoulder_height == 1.1


def at(*keys: str | int, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(data: Any) -> None:
        for key in keys[:-1]:
            data = data[key]
        data[keys[-1]] = value

    return change


DAMAGE: list[tuple[str, Callable[[dict[str, Any]], None], str]] = [
    ("negative radius", at("tomatoes", 0, "shape", "radius", value=-0.03), r"tomatoes\.0.*radius must be a positive"),
    ("zero radius", at("stems", 1, "radius", value=0.0), r"stems\.1.*radius must be a positive"),
    ("NaN radius", at("tomatoes", 1, "shape", "radius", value=float("nan")), r"tomatoes\.1.*radius"),
    (
        "NaN center",
        at("tomatoes", 0, "shape", "center", value=[0.0, float("nan"), 0.0]),
        r"tomatoes\.0\.shape.*center.*finite",
    ),
    ("infinite end", at("stems", 0, "end", value=[0.0, 0.0, float("inf")]), r"stems\.0\.end.*finite"),
    ("two coordinates", at("tomatoes", 0, "shape", "center", value=[0.0, 1.0]), r"tomatoes\.0\.shape.*center.*shape"),
    ("text for numbers", at("tomatoes", 0, "shape", "center", value="here"), r"tomatoes\.0\.shape.*center.*numbers"),
    ("ripeness", at("tomatoes", 0, "ripeness", value=1.5), r"tomatoes\.0.*ripeness must be between"),
    ("truss", at("tomatoes", 0, "truss", value="two"), r"tomatoes\.0\.truss"),
    ("stem kind", at("stems", 0, "kind", value="trunk"), r"stems\.0\.kind.*peduncle"),
    ("flat box", at("clutter", 2, "half_extents", value=[0.1, 0.0, 0.1]), r"clutter\.2.*half_extents"),
    ("mirrored box", at("clutter", 2, "rotation", value=np.diag([1, 1, -1]).tolist()), r"clutter\.2.*rotation"),
    ("unknown version", at("schema_version", value=2), r"schema_version.*1"),
    ("extra key", at("colour", value="red"), r"colour.*[Ee]xtra"),
    ("extra key of a tomato", at("tomatoes", 0, "weight", value=0.1), r"tomatoes\.0\.weight.*[Uu]nexpected"),
    ("extra key of the placement", at("placement", "tilt", value=0.1), r"placement\.tilt.*[Ee]xtra"),
    ("extra key of the provenance", at("provenance", "field", value=1), r"provenance\.field.*[Ee]xtra"),
    ("target out of range", at("targets", 0, "tomato", value=2), r"target names tomato 2, the scene has 2"),
    ("negative target", at("targets", 0, "tomato", value=-1), r"targets\.0\.tomato"),
    ("difficulty", at("targets", 0, "difficulty", value="trivial"), r"targets\.0\.difficulty.*easy"),
    ("shoulder below the floor", at("placement", "shoulder_height", value=-1.0), r"placement\.shoulder_height"),
    ("NaN shoulder", at("placement", "shoulder_height", value=float("nan")), r"placement\.shoulder_height"),
    ("NaN yaw", at("placement", "yaw", value=float("nan")), r"placement\.yaw"),
    ("NaN witness", at("targets", 0, "witness", value=[[0.0, float("nan")]]), r"targets\.0\.witness"),
    ("damaged truth", at("truth", "xz", value="%%"), r"truth.*damaged"),
    (
        "NaN in listed truth",
        at("truth", value={"tomatoes": [{"center": [0, 0, 0], "radius": float("nan"), "truss": 0}]}),
        r"truth\.tomatoes\.0.*radius",
    ),
    ("no name", lambda data: data.pop("name"), r"name.*[Rr]equired"),
    ("no provenance", lambda data: data.pop("provenance"), r"provenance.*[Rr]equired"),
    ("not a list", at("tomatoes", value={"0": 1}), r"tomatoes"),
]


@pytest.mark.parametrize(("change", "problem"), [d[1:] for d in DAMAGE], ids=[d[0] for d in DAMAGE])
def test_a_damaged_scene_names_file_and_field(
    full: Scene, tmp_path: Path, change: Callable[[dict[str, Any]], None], problem: str
) -> None:
    path, data = saved(full, tmp_path)
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(FileFormatError, match=problem) as caught:
        Scene.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize("content", ["", "{", "[1, 2]", "null", "not json", '{"name": "x"} {}', "\x00"])
def test_what_is_no_json_object(tmp_path: Path, content: str) -> None:
    path = tmp_path / "scene.json"
    path.write_text(content)
    with pytest.raises(FileFormatError, match=r"scene\.json: not a valid scene"):
        Scene.load(path)


def test_missing_and_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"none\.json: cannot be read"):
        Scene.load(tmp_path / "none.json")
    with pytest.raises(FileFormatError, match="cannot be read"):
        Scene.load(tmp_path)
    (tmp_path / "latin.json").write_bytes('{"name": "grün"}'.encode("latin-1"))
    with pytest.raises(FileFormatError, match=r"latin\.json"):
        Scene.load(tmp_path / "latin.json")


def test_a_truncated_scene(full: Scene, tmp_path: Path) -> None:
    path, _ = saved(full, tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(FileFormatError, match="not a valid scene"):
        Scene.load(path)


def test_tomatoes_are_written_with_their_shapes(full: Scene, tmp_path: Path) -> None:
    turn = rotation_about([0.0, 1.0, 0.0], 0.5)
    oblate = Tomato(Ellipsoid([0.2, 0.1, 1.0], [0.03, 0.03, 0.03], turn), truss=1)
    path, data = saved(full.model_copy(update={"tomatoes": (*full.tomatoes, oblate)}), tmp_path)
    assert [set(tomato) for tomato in data["tomatoes"]] == [{"shape", "truss", "ripeness"}] * 3
    assert [set(tomato["shape"]) for tomato in data["tomatoes"][:2]] == [{"center", "radius"}] * 2
    again = Scene.load(path).tomatoes[2].shape
    assert isinstance(again, Ellipsoid)
    np.testing.assert_array_equal(again.semi_axes, [0.03, 0.03, 0.03])
    np.testing.assert_array_equal(again.rotation, turn)
