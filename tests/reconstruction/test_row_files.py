from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from row_helpers import half_cloud

from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.reconstruction import load_row, report_as_json, save_row

pytestmark = pytest.mark.xdist_group("row")


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_row(half_cloud(), tmp_path_factory.mktemp("rows") / "row.npz")


def test_round_trip(saved: Path) -> None:
    row, again = half_cloud(), load_row(saved)
    for name in ("points", "colors", "normals"):
        assert getattr(again, name).dtype == np.float64
        np.testing.assert_allclose(getattr(again, name), getattr(row, name), atol=1e-6)
    for name in ("station", "registered", "world_from_station"):
        np.testing.assert_array_equal(getattr(again, name), getattr(row, name))
        assert getattr(again, name).dtype == getattr(row, name).dtype
    assert again.report == row.report


def test_the_report_is_readable_json() -> None:
    data = json.loads(report_as_json(half_cloud().report))
    assert [station["registered"] for station in data["stations"]] == [True] * 5
    assert data["points"] == len(half_cloud())


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_file(saved: Path, tmp_path: Path, share: float) -> None:
    content = saved.read_bytes()
    path = tmp_path / "row.npz"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(FileFormatError, match=r"row\.npz: "):
        load_row(path)


def test_a_file_with_flipped_bytes(saved: Path, tmp_path: Path) -> None:
    content = bytearray(saved.read_bytes())
    content[len(content) // 3] ^= 0xFF
    path = tmp_path / "row.npz"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"row\.npz: "):
        load_row(path)


def test_files_that_are_no_rows(saved: Path, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"none\.npz: cannot be read"):
        load_row(tmp_path / "none.npz")
    text = tmp_path / "text.npz"
    text.write_text("points")
    with pytest.raises(FileFormatError, match=r"text\.npz: not a valid row cloud"):
        load_row(text)
    array = tmp_path / "array.npy"
    np.save(array, np.zeros(3))
    with pytest.raises(FileFormatError, match=r"array\.npy: not a valid row cloud"):
        load_row(array)
    partial = tmp_path / "partial.npz"
    with np.load(saved) as file:
        np.savez(partial, **{name: file[name] for name in file.files if name != "normals"})
    with pytest.raises(FileFormatError, match=r"partial\.npz: not a valid row cloud: .*normals"):
        load_row(partial)


@pytest.mark.parametrize(
    "report", ["{}", "[]", "not json", '{"stations": [{"number": 1}]}', '{"stations": [], "x": 1}']
)
def test_a_file_with_another_report(saved: Path, tmp_path: Path, report: str) -> None:
    path = tmp_path / "row.npz"
    with np.load(saved) as file:
        np.savez(path, **({name: file[name] for name in file.files} | {"report": np.array(report)}))
    with pytest.raises(FileFormatError, match=r"row\.npz: not a valid row cloud"):
        load_row(path)


def test_pickles_are_not_read(saved: Path, tmp_path: Path) -> None:
    path = tmp_path / "row.npz"
    with np.load(saved) as file:
        np.savez(path, **({name: file[name] for name in file.files} | {"points": np.array([{}], dtype=object)}))
    with pytest.raises(FileFormatError, match=r"row\.npz: not a valid row cloud"):
        load_row(path)
