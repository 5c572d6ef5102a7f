"""Check whether a cloud resembles the ones to which the networks were fitted; elsewhere their scores mean nothing."""

from __future__ import annotations

from greenhouse_gym.shapes.surface_cloud import SurfaceCloud

_MIN_COHERENCE = 0.91
"""Least `SurfaceCloud.coherence`; rows that the networks were fitted to have 0.94 to 0.99."""

_MIN_DENSITY = 10.0
"""Least `SurfaceCloud.density`; rows that the networks were fitted to have 20 to 24."""

_MIN_POINTS = 20_000
"""Points below which a cloud is too small to be judged: the normals of a single fruit vary as much as noisy ones."""


def outside_domain(surface: SurfaceCloud) -> str:
    """Return a phrase on the property in which a cloud differs from those the networks were fitted to, or ""."""
    if len(surface) < _MIN_POINTS:
        return ""
    if surface.coherence < _MIN_COHERENCE:
        return f"its normals vary too much within a centimetre (mean length {surface.coherence:.2f}, not 0.94 or more)"
    if surface.density < _MIN_DENSITY:
        return f"its points are too sparse (about {surface.density:.0f} patches of 5 mm within 11 mm, not 20 or more)"
    return ""
