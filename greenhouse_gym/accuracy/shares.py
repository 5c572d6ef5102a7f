"""Shares of a whole."""

from __future__ import annotations


def share(part: float, whole: float) -> float:
    """A part as a share of a whole; NaN where there is no whole."""
    return part / whole if whole else float("nan")
