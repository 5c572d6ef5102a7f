"""Rows of tomato plants with known truth: procedural ones, and plants grown by Helios."""

from greenhouse_gym.crops.cultivars import CULTIVARS, DEVELOPMENT_CULTIVARS, HELD_OUT_CULTIVARS, Cultivar
from greenhouse_gym.crops.organs import Organ
from greenhouse_gym.crops.plant_row import PlantRow
from greenhouse_gym.crops.row import SOURCES, STYLES, grow_row
from greenhouse_gym.crops.truss import FruitStyle

__all__ = [
    "CULTIVARS",
    "DEVELOPMENT_CULTIVARS",
    "HELD_OUT_CULTIVARS",
    "SOURCES",
    "STYLES",
    "Cultivar",
    "FruitStyle",
    "Organ",
    "PlantRow",
    "grow_row",
]
