"""A procedural high-wire tomato row with known truth."""

from greenhouse_gym.plants.row import STYLES, FruitStyle, PlantRow, grow_row

__all__ = ["STYLES", "FruitStyle", "PlantRow", "grow_row"]
