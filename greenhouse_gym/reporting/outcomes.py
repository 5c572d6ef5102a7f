"""The outcome of an episode in words."""

from __future__ import annotations

from collections.abc import Sequence


def outcome(
    success: bool, collision: bool, contact: Sequence[str], steps: int, distance: float, failure: str = ""
) -> str:
    """Describe how an episode ended; the values are those of `greenhouse_gym.evaluation.Record`."""
    if failure:
        return f"gave up after {steps} actions: {failure}"
    if success:
        return f"reached it after {steps} actions"
    if collision:
        return f"hit {contact[-1]} with its {contact[0]} after {steps} actions"
    return f"ended {100 * distance:.0f} cm from it after {steps} actions"
