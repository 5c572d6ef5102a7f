from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from row_helpers import full_recording, grown

from greenhouse_gym.capture import open_recording, simulate_recording, write_recording
from greenhouse_gym.crops.truth_shapes import TRUTH, load_truth, save_truth
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import distance_to_shapes


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_truth(grown(), tmp_path_factory.mktemp("truth") / TRUTH)


def test_a_simulated_recording_knows_its_row() -> None:
    row = grown()
    assert simulate_recording(row, seed=1).truth is row


def test_truth_survives_the_disk(tmp_path: Path) -> None:
    short = replace(full_recording(), size=1)
    truth = open_recording(write_recording(short, tmp_path / "simulated")).truth
    assert truth is not None
    assert truth.behind is not None
    row = grown()
    assert (truth.length, truth.week) == (row.length, row.week)
    points = np.random.default_rng(0).uniform([0, 0, 0.4], [1, 0.5, 2.2], (200, 3))
    for part in ("tomatoes", "stems", "clutter"):
        assert len(getattr(truth, part)) == len(getattr(row, part))
    near, far = (distance_to_shapes(points, each.shapes) for each in (truth, row))
    np.testing.assert_allclose(np.sort(near, axis=1), np.sort(far, axis=1), atol=1e-9)
    assert [t.ripeness for t in truth.tomatoes] == [t.ripeness for t in row.tomatoes]
    assert [s.kind for s in truth.stems] == [s.kind for s in row.stems]
    real = open_recording(write_recording(replace(short, truth=None), tmp_path / "real"))
    assert real.truth is None


def rewritten(path: Path, folder: Path, **changes: np.ndarray | None) -> Path:
    with np.load(path) as file:
        arrays = dict(file) | changes
    other = folder / TRUTH
    with other.open("wb") as opened:
        np.savez(opened, **{name: array for name, array in arrays.items() if array is not None})
    return other


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"boxes": None}, "boxes"),
        ({"boxes": np.zeros((3, 9))}, "columns"),
        ({"stems": np.full((1, 8), np.nan)}, "finite"),
        ({"tomatoes": np.array([["a"]])}, "float64"),
        ({"spheres": np.array([{}], dtype=object)}, "object of shape"),
        ({"size": np.array([0.0, 0.0])}, "positive length"),
        ({"size": np.array([1.0])}, "unpack"),
        ({"spheres": np.ones((300_001, 4))}, "at most"),
        ({"more": np.zeros(10_000_000)}, "too large"),
    ],
)
def test_damaged_truth_is_named(
    written: Path, tmp_path: Path, changes: dict[str, np.ndarray | None], message: str
) -> None:
    with pytest.raises(FileFormatError, match=rf"truth\.npz.*{message}"):
        load_truth(rewritten(written, tmp_path, **changes))


def test_what_is_no_zip_is_named(tmp_path: Path) -> None:
    (tmp_path / TRUTH).write_bytes(b"nothing of the kind")
    with pytest.raises(FileFormatError, match="truth"):
        load_truth(tmp_path / TRUTH)
    with zipfile.ZipFile(tmp_path / TRUTH, "w") as file:
        file.writestr("size.npy", b"\x93NUMPY")
    with pytest.raises(FileFormatError, match="truth"):
        load_truth(tmp_path / TRUTH)
    assert load_truth(tmp_path / "none.npz") is None
