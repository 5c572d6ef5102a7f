from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.crops import STYLES, TOMATO, Crop, Palette, PlantRow, grow_row
from greenhouse_gym.crops.crop import HIGHEST_TRUSS, LOWEST_TRUSS, PLANT_SPACING, STEM_LINE, TRUSS_SPACING
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.errors import GreenhouseError, InvalidValueError, UnknownNameError
from greenhouse_gym.geometry import Shape, distance_to_capsules


def numbers(shape: Shape) -> dict[str, Any]:
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(shape).items()}


def everything(row: PlantRow) -> list[dict[str, Any]]:
    own = [numbers(shape) for shape in row.shapes]
    own += [{"truss": tomato.truss, "ripeness": tomato.ripeness} for tomato in row.tomatoes]
    return own if row.behind is None else own + everything(row.behind)


def trusses(row: PlantRow) -> list[list[Tomato]]:
    by_number = itertools.groupby(sorted(row.tomatoes, key=lambda t: t.truss), key=lambda t: t.truss)
    return [list(group) for _, group in by_number]


def main_stems(row: PlantRow) -> list[Stem]:
    return [stem for stem in row.stems if stem.kind == "main"]


@pytest.fixture(scope="module", params=sorted(STYLES))
def style(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def row(style: str) -> PlantRow:
    return grow_row(seed=3, length=2.0, style=style)


def test_same_seed_same_row() -> None:
    assert everything(grow_row(5, 1.0, week=2)) == everything(grow_row(5, 1.0, week=2))


def test_other_seeds_give_other_rows() -> None:
    rows = [everything(grow_row(seed, 1.0)) for seed in range(4)]
    assert all(a != b for a, b in itertools.combinations(rows, 2))


def test_front_and_back_rows_differ() -> None:
    row = grow_row(0, 1.0)
    assert row.behind is not None
    assert len(row.behind.tomatoes) != len(row.tomatoes) or any(
        a.radius != b.radius for a, b in zip(row.behind.tomatoes, row.tomatoes, strict=True)
    )
    assert min(t.center[0] for t in row.behind.tomatoes) > max(t.center[0] for t in row.tomatoes)


PUBLISHED = {  # fruit diameters in millimetres, fruits per truss
    "cluster": ((45, 67), (3, 5)),
    "beefsteak": ((67, 95), (3, 4)),
    "cherry": ((26, 34), (10, 20)),
}


def test_fruit_sizes_and_counts_are_those_of_the_style(row: PlantRow, style: str) -> None:
    (smallest, largest), (fewest, most) = PUBLISHED[style]
    diameters = np.array([2e3 * t.radius for t in row.tomatoes])
    assert diameters.min() >= smallest - 1e-9
    assert diameters.max() <= largest + 1e-9
    assert np.ptp(diameters) > 0.4 * (largest - smallest)
    counts = [len(truss) for truss in trusses(row)]
    assert min(counts) >= fewest
    assert max(counts) <= most
    assert len(set(counts)) > 1


@pytest.mark.parametrize("style", sorted(STYLES))
@pytest.mark.parametrize("seed", range(6))
def test_fruits_do_not_overlap_on_their_truss(seed: int, style: str) -> None:
    for truss in trusses(grow_row(seed, 2.0, style=style)):
        for a, b in itertools.combinations(truss, 2):
            assert np.linalg.norm(a.center - b.center) > a.radius + b.radius - 1e-3


def test_fruits_do_not_swallow_their_main_stem(row: PlantRow) -> None:
    stems = main_stems(row)
    centers = np.array([t.center for t in row.tomatoes])
    radii = np.array([t.radius for t in row.tomatoes])
    gap = distance_to_capsules(centers, [s.start for s in stems], [s.end for s in stems], [s.radius for s in stems])
    assert (gap.min(axis=1) - radii).min() > -0.002


def test_every_truss_has_a_peduncle_and_every_fruit_a_pedicel(row: PlantRow) -> None:
    kinds = [stem.kind for stem in row.stems]
    assert kinds.count("peduncle") == 6 * len(trusses(row))
    assert kinds.count("pedicel") == len(row.tomatoes)
    ends = np.array([stem.end for stem in row.stems if stem.kind == "pedicel"])
    for tomato in row.tomatoes:  # a pedicel ends on the skin
        assert np.abs(np.linalg.norm(ends - tomato.center, axis=1) - tomato.radius).min() < 1e-9


def test_plants_stand_on_the_line_in_their_spacing() -> None:
    row = grow_row(1, 6.0)
    feet = np.array([stem.start for stem in main_stems(row) if stem.start[2] < 0.51])
    sway = 0.03  # the foot of a stem sways, too
    assert np.abs(feet[:, 0] - STEM_LINE).max() <= 0.03 + sway
    gaps = np.diff(np.sort(feet[:, 1]))
    assert gaps.min() >= PLANT_SPACING[0] - 2 * sway
    assert gaps.max() <= PLANT_SPACING[1] + 2 * sway
    assert PLANT_SPACING[0] < gaps.mean() < PLANT_SPACING[1]
    assert feet[:, 1].min() <= 0.0
    assert feet[:, 1].max() >= 6.0


def test_main_stems_reach_from_the_gutter_to_the_wire() -> None:
    all_stems = main_stems(grow_row(2, 1.0))
    plants = [all_stems[k : k + 19] for k in range(0, len(all_stems), 19)]
    assert len(plants) >= 3
    for stems in plants:
        assert stems[0].start[2] == pytest.approx(0.5)
        assert stems[-1].end[2] == pytest.approx(2.4)
        for a, b in itertools.pairwise(stems):
            np.testing.assert_array_equal(a.end, b.start)
            assert a.radius == b.radius
            assert 0.004 <= a.radius <= 0.007


def nodes_of_one_plant(row: PlantRow) -> np.ndarray:
    """Heights at which the trusses of the first plant leave its stem, upwards."""
    axes = [stem for stem in row.stems if stem.kind in ("main", "peduncle")]
    first_plant = list(itertools.takewhile(lambda s: s.kind == "main", axes))
    last = len(first_plant)
    peduncles = list(itertools.takewhile(lambda s: s.kind == "peduncle", axes[last:]))
    return np.array([peduncle.start[2] for peduncle in peduncles[::6]])


@pytest.mark.parametrize("seed", range(5))
def test_trusses_are_spaced_evenly(seed: int) -> None:
    nodes = nodes_of_one_plant(grow_row(seed, 1.0))
    gaps = np.diff(nodes)
    assert TRUSS_SPACING[0] <= gaps[0] <= TRUSS_SPACING[1]
    np.testing.assert_allclose(gaps, gaps[0], atol=1e-9)
    assert nodes[0] >= LOWEST_TRUSS
    assert nodes[-1] <= HIGHEST_TRUSS


@pytest.mark.parametrize("seed", range(3))
def test_a_week_lowers_the_same_trusses_by_one_spacing_and_ripens_them(seed: int) -> None:
    now, later = grow_row(seed, 0.1), grow_row(seed, 0.1, week=1)
    spacing = np.diff(nodes_of_one_plant(now))[0]
    np.testing.assert_allclose(nodes_of_one_plant(later), nodes_of_one_plant(now), atol=1e-9)  # same places, new fruit
    count = len(nodes_of_one_plant(now))
    old, new = trusses(now)[:count], trusses(later)[:count]
    for above, below in zip(old[1:], new[:-1], strict=True):
        assert [t.radius for t in above] == [t.radius for t in below]
        # the stem sways, so a truss also moves sideways by up to a few centimetres
        moved = np.array([b.center - a.center for a, b in zip(above, below, strict=True)])
        np.testing.assert_allclose(moved[:, 2], -spacing, atol=5e-3)
        assert np.abs(moved[:, :2]).max() < 0.06
        ripened = [b.ripeness - a.ripeness for a, b in zip(above, below, strict=True)]  # type: ignore[operator]
        assert min(ripened) >= 0
        if 0.15 < np.mean([t.ripeness for t in above]) < 0.85:  # neither green nor red all through
            assert min(ripened) > 0.1


def test_ripeness_falls_with_height() -> None:
    row = grow_row(4, 4.0)
    low, high = ([t.ripeness for t in row.tomatoes if a < t.center[2] < b] for a, b in ((0.5, 0.7), (1.6, 2.2)))
    assert np.mean(low) > 0.9
    assert np.mean(high) < 0.1


def test_leaves_are_taken_off_below_the_ripe_fruit() -> None:
    leaves = [s for s in grow_row(4, 3.0).clutter if not hasattr(s, "half_extents") or s.half_extents[1] < 0.5]
    heights = [s.start[2] for s in leaves if hasattr(s, "start")]
    assert len(leaves) > 100
    assert min(heights) > 0.8


def test_truss_numbers_are_unique_and_a_stem_line_moves_the_row() -> None:
    row = grow_row(7, 1.0, stem_line=0.8)
    same = grow_row(7, 1.0)
    assert len(row.tomatoes) == len(same.tomatoes)
    for a, b in zip(row.tomatoes, same.tomatoes, strict=True):
        np.testing.assert_allclose(a.center - b.center, [0.3, 0, 0], atol=1e-9)
    for truss in trusses(row):  # one truss hangs together
        assert np.ptp([t.center for t in truss], axis=0).max() < 0.4


@pytest.mark.parametrize("length", [0.0, -1.0, np.nan, np.inf])
def test_a_row_needs_a_length(length: float) -> None:
    with pytest.raises(InvalidValueError, match="length"):
        grow_row(0, length)


def test_bad_weeks_styles_and_seeds_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="week"):
        grow_row(0, 1.0, week=-1)
    with pytest.raises(UnknownNameError, match=r"'chery'.*Did you mean 'cherry'"):
        grow_row(0, 1.0, style="chery")
    with pytest.raises(GreenhouseError, match="seed"):
        grow_row(-1, 1.0)


def test_the_tomato_crop_grows_what_grow_row_does() -> None:
    assert everything(TOMATO.grow(5, 1.0)) == everything(grow_row(5, 1.0))
    with pytest.raises(UnknownNameError, match=r"source of plants.*own.*helios"):
        TOMATO.grow(5, 1.0, source="paper")


def test_another_crop_has_its_own_colors() -> None:
    def grow(seed: int, length: float, week: int, style: Any, stem_line: float) -> PlantRow:
        return PlantRow((), (Stem([stem_line, 0, 0], [stem_line, 0, 1], 0.01, "main"),), (), length, week)

    blue = Palette(leaf=(0.0, 0.0, 1.0))
    row = Crop("post", {"own": grow}, palette=blue).grow(0, 1.0, stem_line=0.4)
    assert (row.palette, row.stems[0].start[0]) == (blue, 0.4)
    with pytest.raises(InvalidValueError, match="length"):
        Crop("post", {"own": grow}).grow(0, -1.0)
