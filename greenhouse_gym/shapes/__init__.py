"""From a cloud to tomatoes, stems and clutter."""

from greenhouse_gym.shapes.extract import RowShapes, extract_shapes
from greenhouse_gym.shapes.settings import ShapeSettings

__all__ = ["RowShapes", "ShapeSettings", "extract_shapes"]
