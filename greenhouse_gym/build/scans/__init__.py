"""Clouds that were not recorded with this package's rig: read, brought to metres with z up, made a row of scenes."""

from greenhouse_gym.build.scans.files import CLOUD_SUFFIXES, RawCloud, read_cloud
from greenhouse_gym.build.scans.row import ScannedRow, scanned_row
from greenhouse_gym.build.scans.scan import Scan, extract_from_scan, open_scan

__all__ = [
    "CLOUD_SUFFIXES",
    "RawCloud",
    "Scan",
    "ScannedRow",
    "extract_from_scan",
    "open_scan",
    "read_cloud",
    "scanned_row",
]
