from __future__ import annotations

from pathlib import Path

import pytest
from still_agent import StillAgent

pytest.importorskip("moviepy")

from greenhouse_gym.reporting.film import film
from greenhouse_gym.scene import SceneBank


@pytest.mark.filterwarnings("error:.*Overwriting")
def test_an_episode_becomes_a_film(bank: SceneBank, tmp_path: Path) -> None:
    assert film(StillAgent(), tmp_path / "still.mp4", bank=bank, split="train", step_limit=3) is False
    assert (tmp_path / "still.mp4").read_bytes()[4:8] == b"ftyp"
    assert [path.name for path in tmp_path.iterdir()] == ["still.mp4"]
