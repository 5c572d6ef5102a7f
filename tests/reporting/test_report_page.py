from __future__ import annotations

import re
from base64 import b64decode
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from html_pages import HOSTILE, Page

from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, RowReport, StationReport
from greenhouse_gym.reconstruction.edge_fattening import EdgeFattening
from greenhouse_gym.reconstruction.report import CalibrationReport
from greenhouse_gym.rendering.picture_files import write_picture
from greenhouse_gym.reporting.plots import hover, limits_around, svg_plot
from greenhouse_gym.reporting.report_page import report_page, typical_pair

HEAD = np.array([0.0, 0.0, 1.1])


STATIONS = (
    StationReport(0, True, segment=0),
    StationReport(1, True, 0, "", 60, 0.9, 0.0012, 0),
    StationReport(2, False, 1, "silhouettes differ by 95% at the best shift", None, 0.0, float("nan"), None),
    StationReport(3, True, 1, "", 61, 0.8, 0.0013, 0, ("last",)),
    StationReport(4, True, 3, "", 62, 0.7, 0.0014, 0),
    StationReport(5, True, 4, "fitness 0.20 below 0.6", 63, 0.2, 0.0041, 1),
    StationReport(6, True, 5, "", 64, 0.95, 0.0011, 1),
)
CALIBRATION = CalibrationReport({"first": 0.0031, "last": -0.002}, {}, {}, 0.00089, 0.00065)


def segment(number: int, stations: tuple[int, ...], points: int, report: RowReport) -> RowCloud:
    registered = np.isin(np.arange(len(report.stations)), stations)
    poses = np.full((len(report.stations), 4, 4), np.nan)
    poses[registered] = np.eye(4)
    poses[registered, 1, 3] = 0.1 * np.arange(registered.sum())
    cloud = np.zeros((3, points, 3))
    return RowCloud(*cloud, np.zeros(points, dtype=np.int32), registered, poses, replace(report, segment=number))


def two_segments(**changes: object) -> list[RowCloud]:
    report = RowReport(STATIONS, ((0, 1, 3, 4), (5, 6)), calibration=CALIBRATION, seconds={"register": 12.4})
    report = replace(report, **changes)
    return [segment(0, (0, 1, 3, 4), 12_000, report), segment(1, (5, 6), 345, report)]


def page(rows: list[RowCloud], name: str = "row 7", pictures: tuple[Path, ...] = ()) -> str:
    return report_page(name, rows, 1500, HEAD, ReconstructionSettings(), (0, 1), pictures)


def test_headline_figures_and_warnings() -> None:
    html = page(two_segments(warnings=("the row falls apart", "look & see")))
    texts = Page(html).texts
    for figure in ("6 of 7", "12,345", "1,500", "0.40 m"):
        assert figure in texts
    assert texts[texts.index("segments") + 1] == "2"
    assert html.count('<p class="warning">') == 2
    assert "look &amp; see" in html
    assert "warning" not in "".join(Page(page(two_segments())).texts)


def test_the_table_lists_each_station() -> None:
    html = page(two_segments())
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", line) for line in html.splitlines() if line.count("<td") == 7]
    rows[0] = rows[0][-7:]
    assert rows == [
        ["0", "", "", "", "", "1", ""],
        ["1", "0", "60", "0.90", "1.20", "1", ""],
        ["2", "rejected by 1", "", "", "", "none", "silhouettes differ by 95% at the best shift"],
        ["3", "1", "61", "0.80", "1.30", "1", "camera &#39;last&#39; saw no foreground"],
        ["4", "3", "62", "0.70", "1.40", "1", ""],
        ["5", "rejected by 4", "63", "0.20", "4.10", "2", "fitness 0.20 below 0.6"],
        ["6", "5", "64", "0.95", "1.10", "2", ""],
    ]


def test_each_segment_has_files_and_a_path() -> None:
    parsed = Page(page(two_segments()))
    text = "\n".join(parsed.texts)
    assert "row.npz, row.ply" in text
    assert "segment 2: 2 of stations 5 to 6, 345 points" in text
    assert "row-2.npz, row-2.ply" in text
    assert len(parsed.all("svg")) == 2 + 2
    dots = [text for text in parsed.texts if re.match(r"station \d", text)]
    assert len(dots) == 5 + 5 + 4 + 2  # a rejected station without a result has no dot
    assert "station 5: 0.20" in text


def test_what_was_found_out_about_the_cameras() -> None:
    text = " ".join(Page(page(two_segments())).texts)
    assert "0.89 mm before calibration and 0.65 mm after it" in text
    assert "0.31% too long" in text
    assert "0.20% too short" in text
    assert "stand where the rig file has them" in text
    moved = replace(CALIBRATION, turned={"first": 0.01, "last": 0.0}, shifted={"first": 0.0021, "last": 0.0})
    text = " ".join(Page(page(two_segments(calibration=moved))).texts)
    assert "The rig was corrected" in text
    assert "0.57°" in text
    assert "2.1 mm" in text
    unknown = CalibrationReport({"middle": 0.0}, {}, {})
    assert "too little of their view" in " ".join(Page(page(two_segments(calibration=unknown))).texts)


def test_fattened_edges_are_reported() -> None:
    for calibration in (CALIBRATION, CalibrationReport({"middle": 0.0}, {}, {})):
        assert "px too far" not in " ".join(Page(page(two_segments(calibration=calibration))).texts)
        grown = replace(calibration, edge_fattening=EdgeFattening(2, 0))
        text = " ".join(" ".join(Page(page(two_segments(calibration=grown))).texts).split())
        assert "reached 2 px too far along the rows of the depth images and 0 px too far along their columns" in text


def test_all_text_is_escaped() -> None:
    stations = (
        *STATIONS[:2],
        replace(STATIONS[2], reason=HOSTILE),
        replace(STATIONS[3], blind=(HOSTILE,)),
        *STATIONS[4:],
    )
    calibration = CalibrationReport({HOSTILE: 0.01}, {}, {}, 0.001, 0.001)
    html = page(
        two_segments(stations=stations, calibration=calibration, warnings=(HOSTILE,), seconds={HOSTILE: 1.0}), HOSTILE
    )
    parsed = Page(html)
    assert not parsed.all("script")
    assert "<script" not in html
    assert parsed.texts.count(HOSTILE) >= 5  # title, heading, warning, camera, reason


def test_the_page_needs_nothing_else(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (90, 120, 3), dtype=np.uint8)
    flat = np.full((50, 400, 3), 200, dtype=np.uint8)
    pictures = (write_picture(noise, tmp_path / "1-two-images.png"), write_picture(flat, tmp_path / "8-mesh.png"))
    parsed = Page(page(two_segments(), pictures=pictures))
    kinds = []
    for image, expected in zip(parsed.all("img"), (noise, flat), strict=True):
        source = re.fullmatch(r"data:image/(png|jpeg);base64,(.+)", image["src"] or "")
        assert source
        kind, data = source.groups()
        decoded = cv2.imdecode(np.frombuffer(b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert decoded.shape == expected.shape
        assert image["alt"]
        kinds.append(kind)
    assert kinds == ["jpeg", "png"]
    assert "Stations 0 and 1 of the reference camera: neighbors of median fitness." in parsed.texts
    for tag, attributes in parsed.tags:
        assert tag not in {"script", "link", "iframe", "object"}
        assert not {"href", "srcset", "onload", "onerror"} & set(attributes)


def test_a_single_station_makes_a_page_too() -> None:
    report = RowReport((StationReport(0, False, segment=None),), ((0,),))
    parsed = Page(page([segment(0, (0,), 5, report)]))
    assert "1 of 1" in parsed.texts


def test_the_pair_of_median_fitness_is_shown() -> None:
    assert typical_pair(STATIONS) == (0, 1)  # 0.7, 0.9 and 0.95
    assert typical_pair(STATIONS[3:5]) == (3, 4)
    assert typical_pair(STATIONS[:1]) is None
    assert typical_pair((STATIONS[0], STATIONS[2], STATIONS[3])) is None  # neighbors, but not registered to each other


@pytest.mark.parametrize(
    ("values", "min_range", "limits"),
    [([3.0], 0.2, (2.9, 3.1)), ([0.0, 1.0], 0.2, (-0.06, 1.06)), ([0.0, 1.0], 2.0, (-0.5, 1.5))],
)
def test_an_axis_has_a_margin_around_its_values(
    values: list[float], min_range: float, limits: tuple[float, float]
) -> None:
    assert limits_around(values, min_range) == pytest.approx(limits)


def test_a_plot_is_the_same_each_time_and_escapes_its_texts() -> None:
    def draw(axes: Any) -> None:
        for k, name in enumerate((HOSTILE, "<b>")):
            hover(axes.plot(k, k, "o")[0], name)
        axes.annotate("<c>", (1, 1))
        axes.set(xlabel="<x>", ylabel="<y>")

    drawn = svg_plot(HOSTILE, draw, 200, 100)
    assert drawn == svg_plot(HOSTILE, draw, 200, 100)
    parsed = Page(drawn)
    (svg,) = parsed.all("svg")
    assert svg["viewbox"] == "0 0 200 100"
    assert svg["aria-label"] == HOSTILE
    assert {HOSTILE, "<b>", "<c>", "<x>", "<y>"} <= set(parsed.texts)
    assert not {"script", "metadata"} & {tag for tag, _ in parsed.tags}
    ids = [attributes["id"] for tag, attributes in parsed.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
