"""From a cloud to tomatoes, stems and clutter."""

from greenhouse_gym.shapes.checks import ShapeWarning
from greenhouse_gym.shapes.evidence import Evidence
from greenhouse_gym.shapes.extract import RowShapes, extract_shapes
from greenhouse_gym.shapes.settings import FINE_SHAPES, ShapeSettings

__all__ = ["FINE_SHAPES", "Evidence", "RowShapes", "ShapeSettings", "ShapeWarning", "extract_shapes"]
