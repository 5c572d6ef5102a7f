"""Extraction of tomatoes, stems and clutter from a point cloud."""

from greenhouse_gym.shapes.evidence import Evidence
from greenhouse_gym.shapes.extract import RowShapes, extract_shapes
from greenhouse_gym.shapes.input_checks import ShapeWarning
from greenhouse_gym.shapes.settings import FINE_SHAPES, ShapeSettings

__all__ = ["FINE_SHAPES", "Evidence", "RowShapes", "ShapeSettings", "ShapeWarning", "extract_shapes"]
