"""All settings of shape extraction."""

from __future__ import annotations

from dataclasses import dataclass

from greenhouse_gym.common.setting_checks import check_numbers

_POSITIVE = (
    "voxel", "fine_voxel", "vote_cell", "radius_step", "clutter_cell", "path_step", "stem_slab", "shell", "explained",
    "string_radius", "peduncle_radius", "pedicel_radius", "radii", "small_radii", "pipe_radii", "stem_radii",
    "grids",
)  # fmt: skip
_SHARES = (
    "min_score", "min_score_small", "min_confidence", "skin_alignment",
    "pipe_alignment", "pipe_filled", "clutter_facing", "clutter_aligned", "least_saturation", "min_peduncle",
    "min_bare_peduncle",
)  # fmt: skip


@dataclass(frozen=True)
class ShapeSettings:
    """How a cloud becomes shapes. Lengths are metres.

    Raises:
        InvalidValueError: A value is not what it can be, such as the size of a cell that is not positive.
    """

    voxel: float = 0.003  # the cloud is thinned out to this first
    fine_voxel: float = 0.002  # and to this where small fruit is looked for
    grids: int = 2  # grids of voxels by which tomatoes are looked for; what is found is what they agree upon
    leaf_contrast: float = 0.07  # what is redder than the leaves by this much, as (R - G) / (R + G), is no leaf
    fruit_bend: float = 6.0  # 1/m: what bulges more both ways may be fruit, whatever its color
    stem_bend: float = 25.0  # 1/m: what bends more than this in one direction may be a main stem
    stem_length: float = 4.0  # what spreads so many times as much (a variance) along as across may be a stem, too
    least_saturation: float = 0.15  # fruit and stems have more color than this; gutters and strings are white
    radii: tuple[float, float] = (0.006, 0.050)  # smallest and largest radius of tomatoes
    small_radii: tuple[float, float] | None = (0.0036, 0.0123)  # of those that are looked for there; None for none
    radius_step: float = 0.003  # step from one radius that is tried to the next
    vote_cell: float = 0.005  # side of the cells in which votes for centers are counted
    min_score: float = 0.12  # share of a half sphere's points that vote for its center
    min_score_small: float = 0.25  # the same share for the smallest radii, which leaves are full of
    shell: float = 0.004  # points this near a sphere belong to it
    skin_noise: float = 0.0015  # points that stand out of a fruit by no more than this belong to it
    skin_alignment: float = 0.9  # so do points whose normals have a larger cosine than this with the sphere's
    skin_margin: float = 0.008  # and those that far off it at most, which a camera farther away makes of the skin
    min_confidence: float = 0.35  # least confidence of a tomato, in the mean over the grids
    least_bend: float = 0.35  # times its sphere's bend, both ways, of a fruit that nothing sure hangs beside
    truss_gap: float = 0.035  # largest gap between the skins of neighbors on one truss
    truss_spread: float = 0.09  # largest mean gap between the skins of two parts of one truss
    pipe_radii: tuple[float, float] = (0.014, 0.057)  # from 28 mm grow pipes to mains 114 mm across
    pipe_gap: float = 0.05  # hidden part of a pipe that is bridged
    pipe_arc: float = 1.75  # radians of its round that must show; the near side alone shows about 2.2
    pipe_filled: float = 0.7  # share of its length that must show
    pipe_alignment: float = 0.95  # mean cosine between its points' normals and its own
    pipe_tilt: float = 0.22  # root mean square of its points' normals along its axis; 0.25 and more on a tomato
    pipe_outside: float = 0.5  # points just outside of it per point on it; a box's faces go on beyond their edge
    stem_radii: tuple[float, float] = (0.003, 0.016)  # smallest and largest radius of main stems
    stem_slab: float = 0.03  # slice of height in which a main stem shows as a small disc
    stem_lean: float = 1.0  # metres sideways per metre up of the most slanted stem
    stem_gap: float = 0.30  # hidden part of a main stem that is bridged
    min_stem: float = 0.25  # shortest main stem
    string_radius: float = 0.001  # radius of a string, too thin to measure
    peduncle_radius: float = 0.0019  # radius of a peduncle, too thin to measure; usually 3 to 4.5 mm across
    pedicel_radius: float = 0.0013  # radius of a pedicel, too thin to measure
    longest_pedicel: float = 0.030  # length of the longest pedicel
    truss_reach: float = 0.12  # how far from the center of a fruit what holds it is looked for
    path_step: float = 0.004  # peduncles are traced from point to point this far apart
    min_peduncle: float = 0.2  # least probability of a place on a peduncle
    min_bare_peduncle: float = 0.5  # the same where no fruit that was found hangs on it
    shortest_bare_peduncle: float = 0.025  # from end to end
    path_gap: float = 0.015  # hidden part of a peduncle that is bridged
    path_bridge: float = 0.060  # hidden part that is bridged where several fruits hang on the peduncle
    bridge_fruits: int = 2  # fewest fruits that count as several
    stem_margin: float = 0.008  # points this near a main stem are its own bumps, no peduncle
    root_reach: float = 0.025  # how far from a main stem's axis a peduncle may begin
    pedicel_reach: float = 0.016  # how far from the skin of its fruit a pedicel may end
    axis_tolerance: float = 0.003  # a chain of capsules may be this far from the traced axis
    upright_tolerance: float = 0.006  # the same for main stems and strings
    clutter_per_area: float = 106.0  # most boxes per square metre of what is left
    clutter_claim: float = 0.003  # square metres of empty surface at which two boxes still become one
    clutter_cell: float = 0.005  # boxes are looked for among the cells of this size that hold points
    clutter_facing: float = 0.9  # cosine between the normals of neighbors on one smooth patch
    clutter_flat: float = 0.006  # cells of one flat patch lie this near its plane
    clutter_aligned: float = 0.8  # cosine between the normals of those cells and the plane's
    min_patch_cells: int = 30  # smaller patches are no leaves
    clutter_near: float = 0.007  # points this near a box are covered by it
    clutter_gap: float = 0.012  # points farther apart are different things
    min_lump_cells: int = 40  # fewer are specks, not worth a box
    clutter_margin: float = 0.012  # a box's surface farther than this from all of its points is empty
    explained: float = 0.008  # points this near a shape speak for it

    def __post_init__(self) -> None:
        check_numbers(self, _POSITIVE, _SHARES)


FINE_SHAPES = ShapeSettings(
    clutter_per_area=600.0,
    clutter_claim=0.0,
    min_lump_cells=8,
    clutter_flat=0.002,
    clutter_margin=0.008,
    axis_tolerance=0.0015,
    upright_tolerance=0.002,
)
"""Finer shapes than the default: bent leaves in small flat pieces, more and shorter capsules; for larger scenes."""
