"""Check whether a cloud resembles the ones to which the networks were fitted; elsewhere their scores mean nothing."""

from __future__ import annotations

from greenhouse_gym.shapes.surface_cloud import NO_LEAF, SurfaceCloud

_MIN_COHERENCE, _MIN_LEAFLESS_COHERENCE = 0.85, 0.93
"""Least `SurfaceCloud.coherence` with and without leaves whose color is known.

Thirds of the rows that the networks were fitted to have 0.90 to 0.98, whole ones 0.94 to 0.99; a real frame of an apple
tree, whose flat surfaces have the colors of bark, sky and leaves, has 0.89.
"""

_MAX_HUE_SPREAD = 0.05
"""Largest `SurfaceCloud.leaf_hue_spread` of leaves; rows that the networks were fitted to have 0.01 to 0.04."""

_MAX_NOISE = 0.0026
"""Largest `SurfaceCloud.noise`, m. Rows that the networks were fitted to have 0.0013 to 0.0017; rows recorded from
0.8 m, where the networks work as well, have 0.0017 to 0.0022."""

_MIN_DENSITY = 10.0
"""Least `SurfaceCloud.density`; rows that the networks were fitted to have 20 to 24."""

_MIN_POINTS = 20_000
"""Points below which a cloud is too small to be judged: the normals of a single fruit vary as much as noisy ones."""


def outside_domain(surface: SurfaceCloud) -> str:
    """Return a phrase on the property in which a cloud differs from those the networks were fitted to, or ""."""
    if len(surface) < _MIN_POINTS:
        return ""
    leafless = surface.leaf_hue == NO_LEAF or surface.leaf_hue_spread > _MAX_HUE_SPREAD
    if surface.coherence < (_MIN_LEAFLESS_COHERENCE if leafless else _MIN_COHERENCE):
        color = ", and its flat surfaces do not have the color of leaves" if leafless else ""
        return f"its normals vary too much within a centimetre (mean length {surface.coherence:.2f}, not 0.94){color}"
    if surface.noise > _MAX_NOISE:
        return f"its points scatter by {1e3 * surface.noise:.1f} mm about its surfaces, not by 1.3 to 2.2 mm"
    if surface.density < _MIN_DENSITY:
        return f"its points are too sparse (about {surface.density:.0f} patches of 5 mm within 11 mm, not 20 or more)"
    return ""
