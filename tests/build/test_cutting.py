"""Cutting scenes out of a row: what is refused."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.build.scenes import BuildSettings, _truth_around
from greenhouse_gym.errors import InvalidValueError


def test_a_truth_without_the_place_of_a_station_is_refused() -> None:
    station = SimpleNamespace(world_from_station=None)
    recording: Any = type(
        "Recording", (), {"name": "blind", "truth": object(), "__getitem__": lambda self, i: station}
    )()
    row: Any = None
    with pytest.raises(InvalidValueError, match=r"'blind'.*station 3.*world_from_station.*truth\.npz"):
        _truth_around(recording, row, 3, np.eye(4), BuildSettings())
