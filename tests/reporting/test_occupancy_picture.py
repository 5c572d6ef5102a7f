from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from row_helpers import half_cloud

from greenhouse_gym.capture.image_files import read_color
from greenhouse_gym.reporting.pictures import occupancy_picture


@pytest.mark.xdist_group("row")
def test_the_picture_shows_free_occupied_and_unknown(tmp_path: Path) -> None:
    path, observed = occupancy_picture(half_cloud(), tmp_path)
    colors = np.unique(read_color(path).reshape(-1, 3), axis=0).tolist()
    assert [150, 152, 158] in colors
    assert [250, 251, 252] in colors
    assert [58, 125, 68] in colors
    assert 0.3 < observed < 0.9
