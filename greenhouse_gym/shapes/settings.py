"""Settings of shape extraction."""

from __future__ import annotations

from dataclasses import dataclass

from greenhouse_gym.common.settings_files import check_numbers

_POSITIVE = ("voxel", "fine_voxel", "radii", "small_radii", "pipe_radii", "stem_radii")
_FRACTIONS = ("min_confidence",)


@dataclass(frozen=True)
class ShapeSettings:
    """Settings for extracting shapes from a cloud. Lengths are in metres.

    Raises:
        InvalidValueError: A value is out of range, for example a cell size that is not positive.
    """

    voxel: float = 0.003  # voxel size to which the cloud is downsampled first
    fine_voxel: float = 0.002  # voxel size of the finer cloud in which small fruit is searched
    radii: tuple[float, float] = (0.006, 0.050)  # smallest and largest radius of tomatoes
    small_radii: tuple[float, float] | None = (0.0036, 0.0123)  # radii searched in the finer cloud; None to skip it
    min_confidence: float = 0.35  # confidence a sphere needs to become a tomato
    truss_spread: float = 0.09  # largest mean gap between the skins of two parts of one truss
    pipe_radii: tuple[float, float] = (0.014, 0.057)  # from 28 mm grow pipes to 114 mm mains
    stem_radii: tuple[float, float] = (0.003, 0.016)  # smallest and largest radius of main stems
    axis_tolerance: float = 0.003  # largest distance of a peduncle's capsules from the traced axis
    upright_tolerance: float = 0.006  # the same for main stems and strings
    clutter_per_area: float = 106.0  # largest number of boxes per square metre of remaining surface
    clutter_merge_area: float = 0.003  # empty surface (square metres) up to which two boxes are merged
    clutter_flatness: float = 0.006  # largest distance of a flat patch's cells from its plane
    clutter_margin: float = 0.012  # box surface farther than this from its points counts as empty
    clutter_min_cells: int = 40  # smaller clusters of cells are noise and get no box

    def __post_init__(self) -> None:
        check_numbers(self, _POSITIVE, _FRACTIONS)


FINE_SHAPES = ShapeSettings(
    clutter_per_area=600.0,
    clutter_merge_area=0.0,
    clutter_min_cells=8,
    clutter_flatness=0.002,
    clutter_margin=0.008,
    axis_tolerance=0.0015,
    upright_tolerance=0.002,
)
"""Finer shapes than the default: bent leaves in small flat pieces and shorter capsules, for larger scenes."""
