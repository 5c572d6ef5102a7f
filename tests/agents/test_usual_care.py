"""How far planner agents keep out of unseen space unless told otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.agents.planner_agent import CAREFUL, usual_care
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.seen import EMPTY, SeenSpace


@pytest.mark.parametrize(("protocol", "care"), [(None, CAREFUL), ("paper", CAREFUL), ("upright-back", "free")])
def test_care_is_for_scans_that_do_not_see_the_leaves_in_the_aisle(
    protocol: str | None, care: str | float, bank: SceneBank
) -> None:
    blind: Scene = bank.scene("made-up-0")
    provenance = blind.provenance.model_copy(update={"protocol": protocol})
    seen = SeenSpace.of(np.full((2, 2, 2), EMPTY, dtype=np.uint8), [0.0, 0.0, 0.0], 0.05)
    assert usual_care(blind.model_copy(update={"provenance": provenance, "seen": seen})) == care
    assert usual_care(blind.model_copy(update={"provenance": provenance})) == "free"
