"""From a recording to one cloud of the row, and its mesh."""

from greenhouse_gym.reconstruction.files import load_row, report_as_json, save_row
from greenhouse_gym.reconstruction.fitting import settings_for
from greenhouse_gym.reconstruction.looks import add_looks
from greenhouse_gym.reconstruction.report import RowReport, StationReport
from greenhouse_gym.reconstruction.row import RowCloud, reconstruct_row, reconstruct_segments
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.surface import METHODS, TriangleMesh, simplify_points, triangulate

__all__ = [
    "METHODS",
    "ReconstructionSettings",
    "RowCloud",
    "RowReport",
    "StationReport",
    "TriangleMesh",
    "add_looks",
    "load_row",
    "reconstruct_row",
    "reconstruct_segments",
    "report_as_json",
    "save_row",
    "settings_for",
    "simplify_points",
    "triangulate",
]
