"""The benchmark that tells where agents collide, on scenes of which that is known."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.geometry import Box
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, Shapes
from greenhouse_gym.scene.mjcf import base_position
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

ARM = get_robot("ur5e")


@pytest.fixture
def places(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    import collision_places

    return collision_places


def bare(scene: Scene, clutter: tuple[Box, ...], states: int = FREE) -> Scene:
    """A scene of nothing but boxes, in space that is all the same."""
    space = OccupancyGrid.from_states(np.full((60, 60, 60), states, dtype=np.uint8), [-1.5, -1.5, 0.0], 0.05)
    return scene.model_copy(update={"tomatoes": (), "stems": (), "targets": (), "clutter": clutter, "occupancy": space})


@pytest.mark.parametrize(("states", "name"), [(UNKNOWN, "unknown"), (FREE, "empty"), (OCCUPIED, "surface")])
def test_it_tells_what_was_seen_and_how_far_the_nearest_shape_is(
    places: Any, scene: Scene, states: int, name: str
) -> None:
    told = bare(scene, (Box([0.5, 0.0, 1.0], [0.1, 0.1, 0.1], np.eye(3)),), states)
    assert places.seen_there(told, np.array([0.5, 0.0, 1.115])) == f"{name}, shape within 2 cm"
    assert places.seen_there(told, np.array([0.5, 0.0, 1.16])) == f"{name}, no shape within 5 cm"
    assert places.seen_there(bare(scene, (), states), np.zeros(3)).endswith("no shape within 5 cm")
    assert places.seen_there(told.model_copy(update={"occupancy": None}), np.array([0.5, 0.0, 1.105])).startswith(
        "unsaid"
    )
    assert places.seen_there(told, None) == "no plant"


def test_the_place_lies_between_the_parts_that_touched(places: Any, scene: Scene) -> None:
    """A leaf of the true row on top of the shoulder, which the scan does not have."""
    shoulder = base_position(scene, ARM) + [0.0, 0.0, 0.3]
    leaf = Box(shoulder, [0.3, 0.3, 0.005], np.eye(3))
    truth = Shapes(tomatoes=scene.tomatoes[:1], clutter=(leaf,))
    told = scene.model_copy(update={"truth": truth})
    trace = SimpleNamespace(
        robot=ARM, joints=ARM.start[None], record=SimpleNamespace(contact=("upper_arm", "clutter_0"))
    )
    place = places.place_of(told, trace)
    assert abs(place[2] - shoulder[2]) < 0.1
    assert np.abs(place[:2] - shoulder[:2]).max() < 0.3
    trace.record.contact = ("upper_arm", "wrist_1")
    assert places.place_of(told, trace) is None, "the arm touched itself"


def test_options_make_planners_and_watchful_agents(places: Any) -> None:
    assert places.agent_of("watchful", {"margin": 0.02})._cares[0].margin == 0.02
    planner = places.agent_of("RRTConnect", {"margin": 0.01, "unknown": places.depth_or_rule("0.1")})
    assert (planner.margin, planner.unknown, places.depth_or_rule("avoid")) == (0.01, 0.1, "avoid")
    assert places.agent_of("straight-line", {}).name == "straight-line"
    options: dict[str, Any] = {"margin": 0.02, "image": [128, 96], "unexplained": True}
    assert [places.told(*each) for each in options.items()] == ["margin 0.02", "image 128 x 96", "unexplained"]
    assert places.told("unexplained", False) == "no unexplained"
