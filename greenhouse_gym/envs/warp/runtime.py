"""NVIDIA Warp: import, devices, the folder of compiled kernels, and memory."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from greenhouse_gym.common.isolation import available_memory
from greenhouse_gym.errors import InvalidValueError, require_choice

DEVICES = ("cpu", "cuda")
"""Devices by name; "cuda:1" is the second GPU."""

PRECISIONS = {"float32": wp.float32, "float64": wp.float64}
"""Types of real numbers by name."""

BLOCK_SIZE = 64
"""Threads of a block on a GPU."""

_MEMORY_FRACTION = 0.9  # of the free memory that an environment may take
_ready = False


def open_device(name: str) -> Any:
    """Initialize Warp and return a device.

    Compiled kernels are kept in the folder named by the variable ``WARP_CACHE_PATH``, by default the user's cache
    folder; if neither can be written, in a temporary one.

    Args:
        name: "cpu", "cuda" or "cuda:0", "cuda:1" and so on.

    Raises:
        UnknownNameError: There is no such kind of device.
        InvalidValueError: There is no such GPU, or Warp cannot use it.
    """
    global _ready
    kind, _, index = str(name).partition(":")
    require_choice("device", kind, DEVICES)
    if not _ready:
        folder = os.environ.get("WARP_CACHE_PATH") or Path.home() / ".cache" / "warp"
        if wp.config.kernel_cache_dir is None and not _is_writable(Path(folder)):
            wp.config.kernel_cache_dir = tempfile.mkdtemp(prefix="warp-kernels-")
        with _quiet():
            wp.init()
        _ready = True
    if kind == "cpu":
        return wp.get_device("cpu")
    count = wp.get_cuda_device_count()
    if not (index or "0").isdigit() or int(index or 0) >= count:
        found = f"{count} GPUs" if count else "no GPU, or a driver that is too old for it"
        raise InvalidValueError(f'device {name!r} is not available: Warp found {found}; choose device="cpu"')
    return wp.get_device(f"cuda:{int(index or 0)}")


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Warp except for its errors."""
    level, wp.config.log_level = wp.config.log_level, wp.LOG_ERROR
    try:
        yield
    finally:
        wp.config.log_level = level


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def check_memory(device: Any, needed: int, advice: str) -> None:
    """Raise an error if a device has too little free memory.

    Args:
        device: The device.
        needed: Bytes that will be allocated.
        advice: Ways to need less.

    Raises:
        InvalidValueError: There is too little memory.
    """
    free = device.free_memory if device.is_cuda else available_memory()
    if needed > _MEMORY_FRACTION * free:
        raise InvalidValueError(
            f"{needed / 1e9:.1f} GB are needed on {device.alias}, and {free / 1e9:.1f} GB are free: {advice}"
        )


def load_kernels(kernels: Iterable[wp.Kernel], device: Any) -> None:
    """Load kernels, and say so if they must be compiled first."""
    size = BLOCK_SIZE if device.is_cuda else 1
    folder = Path(wp.config.kernel_cache_dir)
    with _quiet():
        if any(not (folder / kernel.module.get_module_identifier(size)).is_dir() for kernel in kernels):
            print(f"compiling the environment for {device.alias}; the result is kept in {folder}", file=sys.stderr)
        for kernel in kernels:
            kernel.module.load(device, size)


def struct_of(kind: Any, values: Any, device: Any) -> Any:
    """Return a Warp struct with the fields of a dataclass of numpy arrays and numbers, on a device."""
    result = kind()
    for field in fields(values):
        value, target = getattr(values, field.name), kind.vars[field.name].type
        if isinstance(value, np.ndarray) and isinstance(target, wp.array):
            value = wp.array(np.ascontiguousarray(value), dtype=target.dtype, device=device)
        elif isinstance(value, np.ndarray):
            value = target(*value.ravel().tolist())
        setattr(result, field.name, value)
    return result
