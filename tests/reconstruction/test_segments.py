"""Stations that are missing, out of place or repeated: skipped, bridged, or the beginning of a new segment."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from row_helpers import HALF, black, from_stations, full_recording, half_recording, rendered, worst_errors

from greenhouse_gym.capture import Recording, Station, simulate_recording
from greenhouse_gym.crops import grow_row
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, reconstruct_row, reconstruct_segments

pytestmark = pytest.mark.xdist_group("row")

KNOWN = ReconstructionSettings(calibration_stations=0)


@cache
def long_recording() -> Recording:
    """Twelve stations."""
    return rendered(simulate_recording(grow_row(seed=4, length=1.2), seed=4, rig=HALF))


def of(numbers: Sequence[int | None]) -> Recording:
    """The stations of `long_recording` with these numbers, a black one where None is given."""
    stations = [black(long_recording()[0]) if i is None else long_recording()[i] for i in numbers]
    return from_stations(stations, long_recording())


def segments(recording: Recording) -> tuple[RowCloud, ...]:
    """All segments, each compared with the true poses."""
    rows = reconstruct_segments(recording, KNOWN)
    for row in rows:
        metres, degrees = worst_errors(row, recording)
        assert metres < 0.02
        assert degrees < 1.5
    return rows


def registered(row: RowCloud) -> list[int]:
    return np.flatnonzero(row.registered).tolist()


def test_a_gap_splits_the_row_in_two() -> None:
    """Between the fourth station and the fifth lie 60 cm."""
    longest, other = segments(of([0, 1, 2, 3, 9, 10, 11]))
    assert registered(longest) == [0, 1, 2, 3]
    assert registered(other) == [4, 5, 6]
    np.testing.assert_array_equal(other.world_from_station[4], np.eye(4))
    for k, row in enumerate((longest, other)):
        assert row.report.segment == k
        assert row.report.segments == ((0, 1, 2, 3), (4, 5, 6))
        assert [station.segment for station in row.report.stations] == [0] * 4 + [1] * 3
        assert all(station.registered for station in row.report.stations)
        assert set(np.unique(row.station)) == set(registered(row))
        assert row.report.warnings == (
            "the row splits into 2 segments: stations 0 to 3 (4 stations); 4 to 6 (3 stations)",
        )
    beginning = longest.report.stations[4]
    assert beginning.against == 3
    assert beginning.reason


def test_a_gap_of_black_stations_too_long_to_be_bridged_splits_the_row_in_two() -> None:
    """Sixteen steps of at least 3 cm are beyond 45 cm, so the station after them is tried against none."""
    numbers = [0, 1, 2, 3, *[None] * 15, 9, 10, 11]
    longest, other = segments(of(numbers))
    assert registered(longest) == [0, 1, 2, 3]
    assert registered(other) == [19, 20, 21]
    assert longest.report.stations[19].against is None
    assert f"15 of {len(numbers)} stations were skipped" in longest.report.warnings
    assert any("splits into 2 segments" in warning for warning in longest.report.warnings)


def test_the_row_is_the_longest_segment() -> None:
    row = reconstruct_row(of([0, 1, 2, 8, 9, 10, 11]), KNOWN)
    assert registered(row) == [3, 4, 5, 6]
    assert row.report.segments == ((3, 4, 5, 6), (0, 1, 2))


def test_two_stations_beyond_a_gap_are_no_segment() -> None:
    (row,) = segments(of([0, 1, 2, 10, 11]))
    assert registered(row) == [0, 1, 2]
    assert row.report.segments == ((0, 1, 2),)
    assert row.report.stations[3].reason
    assert not row.report.stations[4].registered


@pytest.mark.parametrize("skipped", [(1,), (2, 3), (1, 2)])
def test_skips_are_bridged(skipped: tuple[int, ...]) -> None:
    """With all pixels: what two stations 30 cm apart both see is little."""
    stations = [black(station) if i in skipped else station for i, station in enumerate(full_recording())]
    (row,) = segments(from_stations(stations, full_recording()))
    assert registered(row) == [i for i in range(5) if i not in skipped]
    after = row.report.stations[skipped[-1] + 1]
    assert after.against == skipped[0] - 1
    assert not after.reason
    assert all("foreground" in row.report.stations[i].reason for i in skipped)
    assert np.isnan(row.world_from_station[list(skipped)]).all()


def test_four_skips_in_a_row_are_bridged() -> None:
    """The tripod went on by 30 cm meanwhile."""
    (row,) = segments(of([0, 1, 2, None, None, None, None, 5, 6]))
    assert registered(row) == [0, 1, 2, 7, 8]
    assert row.report.stations[7].against == 2
    assert row.report.warnings == ("4 of 9 stations were skipped",)


def test_a_station_40_cm_out_of_place_is_skipped() -> None:
    (row,) = segments(of([0, 1, 2, 7, 4, 5, 6]))
    assert registered(row) == [0, 1, 2, 4, 5, 6]
    assert row.report.stations[3].reason
    assert row.report.stations[4].against == 2


def test_two_stations_40_cm_out_of_place_are_skipped() -> None:
    (row,) = segments(of([0, 1, 2, 8, 8, 5, 6]))
    assert registered(row) == [0, 1, 2, 5, 6]
    assert row.report.stations[5].against == 2


def test_stations_that_come_twice_get_no_wrong_pose() -> None:
    """Both photographs of a place may become part of the row, in segments that run side by side."""
    rows = segments(of([i // 2 for i in range(8)]))
    assert len(registered(rows[0])) == 4
    for row in rows:
        assert len({i // 2 for i in registered(row)}) == len(registered(row))


def test_one_duplicate_is_skipped() -> None:
    (row,) = segments(of([0, 1, 2, 2, 3, 4]))
    assert registered(row) == [0, 1, 2, 4, 5]
    assert "along the row" in row.report.stations[3].reason


def refusal(stations: Sequence[Station]) -> str:
    with pytest.raises(ReconstructionError) as caught:
        reconstruct_row(from_stations(stations, half_recording()), KNOWN)
    return str(caught.value)


def test_one_place_photographed_again_and_again_is_refused() -> None:
    message = refusal([half_recording()[1]] * 4)
    assert "0 of 4 stations registered, at least 2 needed" in message
    for i in (1, 2, 3):
        assert f"station {i}: moved " in message


def test_too_few_stations_are_an_error_with_the_reason_of_each() -> None:
    """Two stations fit each other, but a quarter of twelve would be three."""
    stations = [*half_recording()][:2] + [black(half_recording()[0])] * 10
    message = refusal(stations)
    assert f"recording {half_recording().name!r}: 2 of 12 stations registered, at least 3 needed." in message
    for i in range(2, 12):
        assert f"station {i}: camera 'middle': 0.0% foreground" in message


def test_stations_all_half_a_metre_apart_are_an_error_with_reasons() -> None:
    with pytest.raises(ReconstructionError, match=r"0 of 3 stations registered.*station 1: \S.*station 2: \S"):
        reconstruct_row(of([0, 5, 10]), KNOWN)


def test_a_single_station_is_a_row_of_its_own() -> None:
    row = reconstruct_row(of([3]), KNOWN)
    assert registered(row) == [0]
    assert len(row) > 1000
