"""Clouds from other sources: read them, convert them to metres with z up, and turn them into rows of scenes."""

from greenhouse_gym.build.scans.cloud_files import CLOUD_SUFFIXES, RawCloud, read_cloud
from greenhouse_gym.build.scans.scan import Scan, ScannedRow, extract_from_scan, open_scan, scanned_row

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
