"""The only module that imports Open3D: its wheel needs libusb, which the wheel ``libusb-package`` carries."""

from __future__ import annotations

import ctypes
from functools import cache
from types import ModuleType

from greenhouse_gym.common.extras import needs


@cache
def open3d() -> ModuleType:
    """Return Open3D, imported at first use.

    Raises:
        MissingDependencyError: The extra ``reconstruct`` is not installed.
        KeyboardInterrupt: The import was interrupted.
    """
    with needs("reconstruct"):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        import open3d as o3d
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    return o3d
