"""Optional dependencies: what is missing is told by the extra of this package that brings it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from types import MappingProxyType

from greenhouse_gym.errors import MissingDependencyError

MODULES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "reconstruct": ("open3d", "cv2", "libusb_package", "threadpoolctl", "yaml"),
        "plan": ("ompl",),
        "train": ("stable_baselines3", "torch", "safetensors", "tensorboard"),
        "viz": ("matplotlib", "moviepy"),
        "cluster": ("ray",),
        "data": ("minari",),
        "onnx": ("onnx", "safetensors"),
    }
)
"""What extras that commands need bring, by the names that are imported."""


@contextmanager
def needs(extra: str) -> Iterator[None]:
    """Import optional packages inside this block.

    Args:
        extra: The extra that brings them.

    Raises:
        MissingDependencyError: One is not installed, or is and cannot be imported; the message tells which of the two.
        KeyboardInterrupt: The import was interrupted; compiled packages tell that as an `ImportError`.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingDependencyError(error.name or str(error), extra) from error
    except ImportError as error:
        if _interrupted(error):
            raise KeyboardInterrupt from error
        raise MissingDependencyError(error.name or "a package", extra, problem=str(error)) from error


def require_extras(*extras: str) -> None:
    """Raise `MissingDependencyError` for the first package of these extras that is missing, without importing any.

    Long work begins with it, so that what its last part needs is not found missing after hours.
    """
    for extra in extras:
        for module in MODULES[extra]:
            if find_spec(module) is None:
                raise MissingDependencyError(module, extra)


def _interrupted(error: BaseException | None) -> bool:
    while error is not None and not isinstance(error, KeyboardInterrupt):
        if "KeyboardInterrupt" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return error is not None
