from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from greenhouse_gym.crops import grow_row
from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box
from greenhouse_gym.scene import Shapes
from greenhouse_gym.scene.plant_motion import move_plants


@pytest.fixture(scope="module")
def plants() -> Shapes:
    row = grow_row(1, 0.6)
    return Shapes(tomatoes=row.tomatoes, stems=row.stems, clutter=row.clutter)  # type: ignore[arg-type]


def moved(plants: Shapes, seed: int = 0, **sizes: float) -> Shapes:
    still = {"truss_turn": 0.0, "truss_swing": 0.0, "stem_shift": 0.0, "leaf_shift": 0.0}
    return move_plants(plants, PlantMotion(**{**still, **sizes}), np.random.default_rng(seed))


def test_same_seed_same_motion_and_none_is_none(plants: Shapes) -> None:
    usual = PlantMotion()
    once, twice = (move_plants(plants, usual, np.random.default_rng(3)) for _ in range(2))
    assert once.model_dump_json() == twice.model_dump_json()
    assert once.model_dump_json() != move_plants(plants, usual, np.random.default_rng(4)).model_dump_json()
    for one, other in zip(moved(plants).tomatoes, plants.tomatoes, strict=True):
        np.testing.assert_allclose(one.center, other.center, atol=1e-12)


def test_a_truss_moves_as_one_piece_about_its_root(plants: Shapes) -> None:
    after = moved(plants, truss_turn=0.3, truss_swing=0.1)
    for truss in {t.truss for t in plants.tomatoes}:
        own = [k for k, t in enumerate(plants.tomatoes) if t.truss == truss]
        one, other = (np.array([shapes.tomatoes[k].center for k in own]) for shapes in (plants, after))
        np.testing.assert_allclose(
            np.linalg.norm(one[:, None] - one, axis=-1), np.linalg.norm(other[:, None] - other, axis=-1), atol=1e-9
        )
    shifts = [np.linalg.norm(a.center - b.center) for a, b in zip(after.tomatoes, plants.tomatoes, strict=True)]
    assert 0.005 < np.median(shifts) < 0.08
    # pedicels still end on their fruit, peduncles still hang together and begin at the stem
    for stem, before in zip(after.stems, plants.stems, strict=True):
        assert stem.length == pytest.approx(before.length, abs=1e-9)
        if stem.kind == "pedicel":
            gaps = [abs(np.linalg.norm(t.center - stem.end) - t.radius) for t in after.tomatoes]
            assert min(gaps) < 1e-6
        if stem.kind in ("main", "string", "pipe"):
            np.testing.assert_array_equal(stem.start, before.start)
    chains = [(a, b) for a in range(len(plants.stems)) for b in (a + 1,) if b < len(plants.stems)]
    joined = [
        (a, b)
        for a, b in chains
        if plants.stems[a].kind == plants.stems[b].kind == "peduncle"
        and np.allclose(plants.stems[a].end, plants.stems[b].start)
    ]
    gaps = [np.linalg.norm(after.stems[a].end - after.stems[b].start) for a, b in joined]
    assert len(gaps) > 20
    assert np.mean(np.array(gaps) < 1e-9) > 0.98


def test_stems_and_leaves_shift_by_the_size_asked_for_and_together(plants: Shapes) -> None:
    after = moved(plants, stem_shift=0.01, leaf_shift=0.02)
    main = [k for k, stem in enumerate(plants.stems) if stem.kind == "main"]
    shifts = np.array([after.stems[k].start - plants.stems[k].start for k in main])
    assert 0.004 < shifts[:, :2].std() < 0.02
    assert (shifts[:, 2] == 0).all()
    for a, b in pairwise(main):
        if np.allclose(plants.stems[a].end, plants.stems[b].start):
            np.testing.assert_allclose(after.stems[a].end, after.stems[b].start)
    leaves = [k for k, s in enumerate(plants.clutter) if isinstance(s, Box) and s.half_extents.max() < 0.1]
    moves = np.array([after.clutter[k].center - plants.clutter[k].center for k in leaves])
    assert 0.008 < moves.std() < 0.04
    gutter = next(k for k, s in enumerate(plants.clutter) if isinstance(s, Box) and s.half_extents.max() > 0.5)
    np.testing.assert_array_equal(after.clutter[gutter].center, plants.clutter[gutter].center)


def test_impossible_motions_are_refused() -> None:
    for value in (-0.1, float("nan"), 2.0, "far"):
        with pytest.raises(InvalidValueError, match="leaf_shift"):
            PlantMotion(leaf_shift=value)  # type: ignore[arg-type]
