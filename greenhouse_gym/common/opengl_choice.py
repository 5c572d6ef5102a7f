"""The environment variable that chooses MuJoCo's OpenGL, checked before MuJoCo is imported."""

from __future__ import annotations

import os
import sys
import warnings

_VARIABLE = "MUJOCO_GL"
_OFF = ("disable", "disabled", "off", "false", "0")


def opengl_choice() -> str:
    """Return the chosen OpenGL, such as "egl"; empty without a choice."""
    return os.environ.get(_VARIABLE, "").lower().strip()


def opengl_is_off() -> bool:
    """Return whether the user switched OpenGL off."""
    return opengl_choice() in _OFF


def drop_broken_opengl_choice() -> None:
    """Drop a choice that is not installed, or that does not exist, with a warning: MuJoCo could not be imported."""
    choice = opengl_choice()
    if not choice or opengl_is_off() or "mujoco" in sys.modules:
        return
    try:
        import mujoco  # noqa: F401
    except Exception as error:  # each kind of OpenGL fails in its own way
        del os.environ[_VARIABLE]
        warnings.warn(
            f"{_VARIABLE}={choice} does not work here ({error}) and is ignored; unset it, or set it to egl, or to off "
            "for images by ray casting",
            stacklevel=3,
        )
