"""Reports of a reconstruction: calibration, stations, row."""

from __future__ import annotations

from dataclasses import dataclass, field

from greenhouse_gym.reconstruction.edge_fattening import EdgeFattening


@dataclass(frozen=True)
class CalibrationReport:
    """Errors of the cameras, as calibration found them.

    Attributes:
        bias: Relative depth error by camera.
        turned: Rotation of each camera against the rig file, radians; empty where the file was kept.
        shifted: Translation of each camera against the rig file, metres; empty where the file was kept.
        gap_before: Median distance between two cameras' readings of a surface by the rig file, metres.
        gap_after: That distance after the calibration, metres.
        edge_fattening: Edge fattening along rows and columns of the depth images, pixels.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    bias: dict[str, float]
    turned: dict[str, float]
    shifted: dict[str, float]
    gap_before: float = 0.0
    gap_after: float = 0.0
    edge_fattening: EdgeFattening = field(default_factory=EdgeFattening)


@dataclass(frozen=True)
class StationReport:
    """Registration of one station.

    Attributes:
        station: Its number.
        registered: Whether it is part of a segment of the row.
        against: The station it was registered to, or that refused it; None where none was tried.
        reason: Reason why it was skipped, or began a new segment, or "".
        shift_pixels: Best shift of the silhouettes.
        fitness: Fraction of the points in view of both stations with a partner after ICP.
        rmse: Root mean square distance of those partners along their normals, metres.
        segment: Number of its segment; None where not registered.
        blind: Cameras without any foreground.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    station: int
    registered: bool
    against: int | None = None
    reason: str = ""
    shift_pixels: int | None = None
    fitness: float | None = None
    rmse: float | None = None
    segment: int | None = None
    blind: tuple[str, ...] = ()


@dataclass(frozen=True)
class RowReport:
    """Report of a reconstructed row.

    Attributes:
        stations: Report of each station.
        segments: Numbers of the stations of each segment, the longest segment first. Stations of two segments could
            not be registered to each other.
        segment: The segment that this cloud shows.
        warnings: Sentences on what a user should check.
        calibration: Errors of the cameras.
        merged_points: Points before outlier removal.
        points: Points after it.
        seconds: Time of each stage.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    stations: tuple[StationReport, ...]
    segments: tuple[tuple[int, ...], ...] = ()
    segment: int = 0
    warnings: tuple[str, ...] = ()
    calibration: CalibrationReport = field(default_factory=lambda: CalibrationReport({}, {}, {}))
    merged_points: int = 0
    points: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
