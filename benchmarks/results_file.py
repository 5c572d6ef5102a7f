"""Where benchmark results go: one JSON file each, with versions and machine."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from greenhouse_gym.common.files import write_atomically

RESULTS = Path(__file__).parent / "results"


def write_results(path: Path, results: Mapping[str, Any], packages: Sequence[str]) -> None:
    """Write figures beside the versions of the packages they depend on and the machine they were measured on."""
    machine = {
        "processor": processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
    }
    versions = {name: version(name) for name in ("greenhouse-gym", "numpy", *packages)}
    write_atomically(path, json.dumps({**results, "versions": versions, "machine": machine}, indent=1) + "\n")


def kept_results(path: Path, about: Mapping[str, Any], parts: Sequence[str]) -> dict[str, Any]:
    """Parts of the results that a file holds already; empty ones where it is about something else, or missing."""
    found = json.loads(path.read_text()) if path.is_file() else {}
    same = all(found.get(name) == value for name, value in json.loads(json.dumps(about)).items())
    return {part: found[part] if same and part in found else {} for part in parts}


def processor() -> str:
    """The processor's name."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"
