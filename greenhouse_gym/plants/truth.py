"""What an arm would touch in a row: every plant organ as convex shapes."""

from __future__ import annotations

from greenhouse_gym.plants.row import PlantRow


def truth_of(row: PlantRow) -> PlantRow:
    """A row, and the one behind it, as shapes to collide with: capsules, spheres or ellipsoids, and thin boxes.

    A row of our own generator is made of such shapes already.
    """
    return row
