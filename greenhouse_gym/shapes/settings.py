"""All settings of shape extraction."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ShapeSettings:
    """How a cloud becomes shapes. Lengths are metres."""

    voxel: float = 0.003  # the cloud is thinned out to this first
    radii: tuple[float, float] = (0.018, 0.042)  # of tomatoes
    radius_step: float = 0.003
    vote_cell: float = 0.005
    min_score: float = 0.12  # share of a half sphere's points that vote for its center
    min_coverage: float = 0.14  # share of a sphere's directions that must be seen
    shell: float = 0.004  # points this near a sphere belong to it
    max_residual: float = 0.0022  # root mean square distance of those points from the sphere
    min_alignment: float = 0.93  # mean cosine between their normals and the sphere's
    max_outside: float = 0.4  # points just outside a sphere per point on it: a leaf goes on where a fruit ends
    truss_gap: float = 0.015  # between the skins of neighbours on one truss
    stem_radii: tuple[float, float] = (0.003, 0.010)  # of main stems
    stem_slab: float = 0.03  # slice of height in which a main stem shows as a small disc
    stem_gap: float = 0.30  # hidden part of a main stem that is bridged
    min_stem: float = 0.25  # shortest main stem
    thin_radii: tuple[float, float] = (0.001, 0.005)  # of peduncles and pedicels
    thin_length: float = 0.04  # piece of a thin stem that one capsule stands for
    clutter_per_metre: int = 90  # boxes
    clutter_gap: float = 0.012  # points farther apart are different things
    min_clutter_points: int = 8  # fewer points are noise
