"""How a reconstruction went: which stations, which not and why, figures of the way."""

from __future__ import annotations

from dataclasses import dataclass, field

from greenhouse_gym.reconstruction.calibration import CalibrationReport


@dataclass(frozen=True)
class StationReport:
    """What happened to one station.

    Attributes:
        station: Its number.
        registered: Whether it is part of a segment of the row.
        against: The station it was registered to, or that refused it; None where none was tried.
        reason: Why it was skipped, or began a new segment, or "".
        shift_pixels: Best shift of the silhouettes.
        fitness: Share of the points both stations could see with a partner after ICP.
        rmse: Root mean square distance of those partners along their normals, metres.
        segment: Number of its segment; None where not registered.
        blind: Cameras that saw no foreground.
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
    """How a reconstruction went.

    Attributes:
        stations: What happened to each station.
        segments: Numbers of the stations of each segment, the longest segment first. Stations of two segments could
            not be registered to each other.
        segment: The segment this cloud shows.
        warnings: What a user should look at, a sentence each.
        calibration: What was found out about the cameras.
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
