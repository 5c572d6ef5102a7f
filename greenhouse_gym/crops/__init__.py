"""Crops: rows of plants with known truth, as analytic shapes or as meshes grown by Helios."""

from greenhouse_gym.crops.crop import Crop, Growth, Palette, PlantMotion, PlantRow
from greenhouse_gym.crops.cultivars import (
    CULTIVARS,
    DEVELOPMENT_CULTIVARS,
    HELD_OUT_CULTIVARS,
    STYLES,
    Cultivar,
    FruitStyle,
)
from greenhouse_gym.crops.organs import Organ
from greenhouse_gym.crops.tomato import SOURCES, TOMATO, grow_row

__all__ = [
    "CULTIVARS",
    "DEVELOPMENT_CULTIVARS",
    "HELD_OUT_CULTIVARS",
    "SOURCES",
    "STYLES",
    "TOMATO",
    "Crop",
    "Cultivar",
    "FruitStyle",
    "Growth",
    "Organ",
    "Palette",
    "PlantMotion",
    "PlantRow",
    "grow_row",
]
