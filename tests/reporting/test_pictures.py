from __future__ import annotations

from pathlib import Path

import pytest
from row_helpers import half_recording

from greenhouse_gym.capture.image_files import read_color
from greenhouse_gym.reconstruction import ReconstructionSettings
from greenhouse_gym.reconstruction.station_views import Calibration
from greenhouse_gym.reporting.pictures import registration_pictures

pytestmark = pytest.mark.xdist_group("row")


def test_a_registration_is_drawn_with_the_cameras_as_they_were_found(tmp_path: Path) -> None:
    """A camera that reports twice the depth has more within 60 cm than it says."""
    rig = half_recording().rig
    shares = []
    for name, bias in (("as-the-rig-file-says", 0.0), ("calibrated", 1.0)):
        calibration = Calibration(rig, {rig.reference: bias})
        files = registration_pictures(half_recording(), 0, 1, calibration, ReconstructionSettings(), tmp_path / name)
        assert files[:2] == [tmp_path / name / "1-two-images.png", tmp_path / name / "2-foreground.png"]
        shares.append((read_color(files[1]) > 0).mean())
    assert shares[1] > 1.05 * shares[0]
