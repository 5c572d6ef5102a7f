"""Names and paths that lead elsewhere, files that are none, sizes nobody has memory for."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zlib
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import make_scene

from greenhouse_gym.capture import Camera, Intrinsics, Recording, RgbdFrame, Rig, Station, open_recording
from greenhouse_gym.capture.formats.bag_readers import open_bag
from greenhouse_gym.capture.formats.own import INDEX, write_recording
from greenhouse_gym.capture.image_files import read_color, read_depth, read_image
from greenhouse_gym.common import files as paths
from greenhouse_gym.common.files import checked_name, parsing, read_bytes
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.scene import Scene, SceneBank, compile_scene
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.manifest import MANIFEST

BAD_NAMES = ["", ".", "..", "../../evil", "/abs/x", "a/b", "a\\b", "C:x", ".hidden", "x.", "x ", "a\0b", "a\nb",
             "manifest", "Manifest", "\ud800", "x" * 300]  # fmt: skip


@pytest.mark.parametrize("name", BAD_NAMES)
def test_names_that_are_no_file_names_are_refused_everywhere(tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidValueError, match="a scene cannot be named"):
        checked_name("a scene", name)
    scene = make_scene(0, stems=1)
    with pytest.raises(ValueError, match="a scene cannot be named"):
        Scene(name=name, provenance=scene.provenance)
    with pytest.raises(InvalidValueError, match="a scene cannot be named"):
        write_bank(tmp_path / "bank", [(scene.model_copy(update={"name": name}), "train")], name="b")
    assert list(tmp_path.rglob("*")) == []


@pytest.mark.parametrize("name", ["row-100-00", "Reihe 3 (süd)", "a.b", "番茄", "x" * 200])
def test_names_of_all_languages_are_welcome(name: str) -> None:
    assert checked_name("a scene", name) == name


# -- paths that a file names ------------------------------------------------------------------------------------------


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """A scene outside of the bank that the manifests below name."""
    return make_scene(1, stems=1).save(tmp_path / "secret.json")


def lead_to(outside: Path, folder: Path, how: str) -> str:
    if how == "link":
        (folder / "link.json").symlink_to(outside)
        return "link.json"
    if how == "folder":
        (folder / "there").symlink_to(outside.parent)
        return f"there/{outside.name}"
    return str(outside) if how == "absolute" else f"../{outside.name}"


LEADS = pytest.mark.parametrize("how", ["absolute", "up", "link", "folder"])


@LEADS
def test_a_manifest_names_files_of_its_folder_only(tmp_path: Path, secret: Path, how: str) -> None:
    bank = write_bank(tmp_path / "bank", [(make_scene(0, stems=1), "train")], name="b")
    manifest = json.loads((bank.path / MANIFEST).read_text())
    digest = hashlib.sha256(secret.read_bytes()).hexdigest()
    manifest["scenes"][0] |= {"file": lead_to(secret, bank.path, how), "sha256": digest}
    (bank.path / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(FileFormatError, match=r"manifest\.json: names the file .*not inside"):
        SceneBank.open(bank.path)[0]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    intrinsics = Intrinsics(4, 3, 2.0, 2.0, 1.5, 1.0)
    frame = RgbdFrame(np.zeros((3, 4, 3), np.uint8), np.ones((3, 4), np.float32), intrinsics)
    rig = Rig({"c": Camera(intrinsics, np.eye(4))}, "c")
    return write_recording(Recording("r", rig, 1, lambda i: Station({"c": frame})), tmp_path / "recording")


@LEADS
@pytest.mark.parametrize("kind", ["color", "depth"])
def test_a_recording_names_images_of_its_folder_only(tmp_path: Path, recording: Path, kind: str, how: str) -> None:
    image = recording / kind / "c" / "000000.png"
    outside = image.rename(tmp_path / "outside.png")
    index = json.loads((recording / INDEX).read_text())
    index["stations"][0][kind]["c"] = lead_to(outside, recording, how)
    (recording / INDEX).write_text(json.dumps(index))
    with pytest.raises(FileFormatError, match=r"recording\.json: names the file .*not inside"):
        open_recording(recording)[0]


def test_links_within_a_recording_are_followed(recording: Path) -> None:
    image = recording / "depth" / "c" / "000000.png"
    image.symlink_to(image.rename(recording / "elsewhere.png"))
    assert open_recording(recording)[0].frames["c"].depth.any()


# -- what is no file --------------------------------------------------------------------------------------------------


def no_files(folder: Path) -> list[Path]:
    os.mkfifo(folder / "pipe")
    return [folder / "pipe", Path("/dev/zero"), Path("/dev/null"), folder]


@pytest.mark.timeout(30)
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes among the files of this system")
def test_pipes_and_devices_are_refused_at_once(tmp_path: Path, recording: Path) -> None:
    for path in no_files(tmp_path):
        with pytest.raises(FileFormatError, match="cannot be read"):
            Scene.load(path)
        with pytest.raises(FileFormatError, match="cannot be read"):
            read_depth(path)
    image = recording / "color" / "c" / "000000.png"
    image.unlink()
    os.mkfifo(image)
    with pytest.raises(FileFormatError, match="not a regular file"):
        open_recording(recording)[0]
    (recording / INDEX).unlink()
    os.mkfifo(recording / INDEX)
    with pytest.raises(FileFormatError):
        open_recording(recording)


@pytest.mark.timeout(30)
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes among the files of this system")
@pytest.mark.parametrize("name", ["walk.mcap", "metadata.yaml"])
def test_a_pipe_in_a_bag_is_refused_at_once(tmp_path: Path, name: str) -> None:
    pytest.importorskip("rosbags")
    for each in ("walk.mcap", "metadata.yaml"):
        os.mkfifo(tmp_path / each) if each == name else (tmp_path / each).write_text("x: 1\n")
    with pytest.raises(FileFormatError, match="not a regular file"):
        open_bag(tmp_path).__enter__()


# -- sizes ------------------------------------------------------------------------------------------------------------


def test_a_file_beyond_its_kinds_limit_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_scene(0, stems=1).save(tmp_path / "scene.json")
    monkeypatch.setattr(paths, "MAX_BYTES", paths.MAX_BYTES | {"scene": 100})
    with pytest.raises(FileFormatError, match=r"too large for a scene: \d+ bytes, at most 100"):
        Scene.load(path)
    sparse = tmp_path / "sparse"
    with sparse.open("wb") as file:
        file.truncate(2**40)
    for kind in paths.MAX_BYTES:
        with pytest.raises(FileFormatError, match="too large"):
            read_bytes(sparse, kind)


def png_header(width: int, height: int, bits: int = 8, color: int = 2) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    size = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(60_000, 60_000), (20_000, 20_000), (2**31 - 1, 2**31 - 1), (1, 2**31 - 1)])
def test_an_image_too_large_is_refused_by_its_header(tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / "large.png"
    path.write_bytes(png_header(*size))
    with pytest.raises(FileFormatError, match=f"{size[0]}x{size[1]} pixels of 3 bytes is too large"):
        read_color(path)


def tiff_header(**numbers: int) -> bytes:
    """The directory of a TIFF file of 64 x 64 pixels with other numbers."""
    tags = {"256": 64, "257": 64, "258": 16, "259": 8, "277": 1} | numbers
    entries = [struct.pack("<HHII", int(tag), 4, 1, value) for tag, value in sorted(tags.items())]
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + b"".join(entries) + bytes(4)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (png_header(8000, 8000, 16, 6), "pixels of 8 bytes is too large"),
        (tiff_header(**{"256": 8000, "257": 8000, "258": 64}), "8000x8000 pixels of 8 bytes is too large"),
        (tiff_header(**{"256": 8000, "257": 8000, "277": 4}), "8000x8000 pixels of 8 bytes is too large"),
        (tiff_header(**{"322": 2**14, "323": 2**14}), "16384x16384 pixels of 2 bytes is too large"),
        (png_header(16, 12)[:33] + (2**30).to_bytes(4, "big") + png_header(16, 12)[37:], "truncated PNG file"),
        (b"P5 60000 60000 65535\n", "60000x60000 pixels of 3 bytes is too large"),
        (b"\xff\xd8" + 101 * b"\xff\xda\0\2" + b"\xff\xd9", "more than 100 scans"),
    ],
)
def test_an_image_that_unpacks_to_much_is_refused_by_its_header(tmp_path: Path, content: bytes, problem: str) -> None:
    path = tmp_path / "image"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=problem):
        read_image(path)


def tomato(radius: float, y: float = 0.0) -> dict[str, Any]:
    return {"shape": {"center": [0.5, y, 1.0], "radius": radius}, "truss": 0}


def many(count: int) -> list[dict[str, Any]]:
    return [tomato(0.03)] * count


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"tomatoes": many(100_000)}, "tomatoes.*at most 2000"),
        ({"truth": {"tomatoes": many(100_000)}}, r"truth\.tomatoes.*at most 2000"),
        ({"tomatoes": [tomato(3e5)]}, r"tomatoes\.0 is larger, or farther away, than 100 m"),
        ({"tomatoes": [tomato(0.03, 1e30)]}, r"tomatoes\.0 is larger, or farther away"),
        ({"placement": {"position": [1e6, 0.0, 0.0]}}, "farther than 100 m"),
        ({"placement": {"shoulder_height": 1e6}}, "shoulder_height"),
    ],
)
def test_scenes_have_limits(tmp_path: Path, fields: dict[str, Any], problem: str) -> None:
    path = tmp_path / "scene.json"
    path.write_text(json.dumps({"name": "large", "provenance": {"row": "r"}} | fields))
    with pytest.raises(FileFormatError, match=problem):
        Scene.load(path)


@pytest.mark.parametrize("capacity", [0, -1, 10**9, "a", 1.5])
def test_what_is_no_capacity(capacity: Any) -> None:
    with pytest.raises(InvalidValueError, match=r"capacity must be a whole number from 1 to 30000"):
        compile_scene(make_scene(0, stems=1), capacity=capacity)


def test_panics_of_rust_and_full_memory_are_told_like_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    highlevel = pytest.importorskip("rosbags.highlevel")

    class PanicException(BaseException):
        pass

    with pytest.raises(FileFormatError, match="not a valid scene: PyObject pointer is null"), parsing("s", "scene"):
        raise PanicException("PyObject pointer is null")
    with pytest.raises(KeyboardInterrupt), parsing("s", "scene"):
        raise KeyboardInterrupt

    def fill(paths: list[Path]) -> None:
        raise MemoryError

    monkeypatch.setattr(highlevel, "AnyReader", fill)
    with pytest.raises(FileFormatError, match="more memory than there is"), open_bag(tmp_path):
        pass


def test_a_command_that_fills_the_memory_ends_with_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fill() -> None:
        raise MemoryError("Unable to allocate 1 GiB")

    command_line = import_module("greenhouse_gym.cli.main")
    monkeypatch.setattr(command_line, "app", fill)
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == 1
    assert capsys.readouterr().err == "error: there is not enough memory (Unable to allocate 1 GiB)\n"
