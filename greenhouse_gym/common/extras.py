"""Optional dependencies: errors name the extra of this package that installs a missing one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from types import MappingProxyType

from greenhouse_gym.errors import MissingDependencyError

MODULES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "reconstruct": ("open3d", "cv2", "libusb_package", "threadpoolctl", "yaml", "matplotlib"),
        "plan": ("ompl",),
        "train": ("stable_baselines3", "torch", "safetensors", "tensorboard", "pandas"),
        "viz": ("matplotlib", "moviepy", "imageio_ffmpeg"),
        "cluster": ("ray",),
        "data": ("minari", "h5py"),
        "warp": ("warp",),
        "onnx": ("onnx", "safetensors"),
    }
)
"""Import names of the packages that each extra installs, for the extras that commands need."""


@contextmanager
def needs(extra: str) -> Iterator[None]:
    """Import optional packages inside this block.

    Args:
        extra: The extra that brings them.

    Raises:
        MissingDependencyError: A package is not installed, or is installed and cannot be imported; the message says
            which.
        KeyboardInterrupt: The import was interrupted; compiled packages report that as an `ImportError`.
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

    Call it before long work, so that a package needed only in the last step is not found missing after hours.
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
