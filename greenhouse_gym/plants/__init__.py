"""A procedural high-wire tomato row with known truth."""

from greenhouse_gym.plants.row import STYLES, PlantRow, grow_row
from greenhouse_gym.plants.truss import FruitStyle

__all__ = ["STYLES", "FruitStyle", "PlantRow", "grow_row"]
