"""From a recording to one cloud of the row, and its mesh."""

from greenhouse_gym.reconstruction.files import load_row, report_as_json, save_row
from greenhouse_gym.reconstruction.row import RowCloud, reconstruct_row
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.surface import METHODS, TriangleMesh, simplify_points, triangulate
from greenhouse_gym.reconstruction.track import RowReport, StationReport

__all__ = [
    "METHODS",
    "ReconstructionSettings",
    "RowCloud",
    "RowReport",
    "StationReport",
    "TriangleMesh",
    "load_row",
    "reconstruct_row",
    "report_as_json",
    "save_row",
    "simplify_points",
    "triangulate",
]
