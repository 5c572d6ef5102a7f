from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from greenhouse_gym.common.jit import inlined, kernel


def made(source: str) -> dict[str, object]:
    """Return the definitions of a source without a file, for which numba finds no cache folder."""
    names: dict[str, object] = {"inlined": inlined, "kernel": kernel, "np": np}
    exec(compile(source, "<nowhere>", "exec"), names)
    return names


def test_without_a_folder_for_its_cache_a_kernel_is_compiled_all_the_same() -> None:
    names = made(
        "@inlined\ndef double(x):\n    return 2 * x\n\n"
        "@kernel('f8(f8[::1])')\ndef total(values):\n    result = 0.0\n    for value in values:\n"
        "        result += double(value)\n    return result\n"
    )
    assert names["total"](np.arange(4.0)) == 12.0  # type: ignore[operator]


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() == 0, reason="needs a folder that cannot be written")
def test_an_unwritable_cache_folder_is_no_error(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    imported = "import greenhouse_gym.scene.tree_kernel"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "HOME": str(tmp_path)}
    assert subprocess.run([sys.executable, "-c", imported], env=environment, check=False).returncode == 0


def test_the_package_and_its_commands_start_without_numba() -> None:
    code = "import sys, greenhouse_gym, greenhouse_gym.envs, greenhouse_gym.cli; print('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
