"""Reconstruction of recordings: the cloud of a row, its mesh, and the occupancy of the space in front of it."""

from greenhouse_gym.reconstruction.meshing import METHODS, TriangleMesh, simplify_points, triangulate
from greenhouse_gym.reconstruction.report import RowReport, StationReport
from greenhouse_gym.reconstruction.row_cloud import RowCloud, reconstruct_row, reconstruct_segments
from greenhouse_gym.reconstruction.row_files import load_row, report_as_json, save_row
from greenhouse_gym.reconstruction.settings import ReconstructionSettings, settings_for

__all__ = [
    "METHODS",
    "ReconstructionSettings",
    "RowCloud",
    "RowReport",
    "StationReport",
    "TriangleMesh",
    "load_row",
    "reconstruct_row",
    "reconstruct_segments",
    "report_as_json",
    "save_row",
    "settings_for",
    "simplify_points",
    "triangulate",
]
