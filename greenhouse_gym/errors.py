"""The package's errors: each names the value or file at fault, what was expected and the valid choices."""

from __future__ import annotations

import math
from collections.abc import Iterable
from difflib import get_close_matches
from numbers import Integral, Real
from typing import Any

import numpy as np

_LONGEST = 1000  # characters of what a damaged file held that a message repeats


class GreenhouseError(Exception):
    """Base of every error this package raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _restore, (type(self), self.args, self.__dict__)


def _restore(kind: type[GreenhouseError], args: tuple[object, ...], attributes: dict[str, object]) -> GreenhouseError:
    """Rebuild a pickled error from its message and attributes, without calling its constructor."""
    error = kind.__new__(kind)
    super(GreenhouseError, error).__init__(*args)
    error.__dict__.update(attributes)
    return error


class InvalidValueError(GreenhouseError, ValueError):
    """A value is not allowed."""


class UnknownNameError(GreenhouseError, KeyError):
    """A name is unknown; the message lists the valid ones."""

    def __init__(self, kind: str, name: object, choices: Iterable[str]):
        self.choices = tuple(choices)
        near = get_close_matches(str(name), self.choices, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        shown = ", ".join(self.choices[:40]) + (", ..." if len(self.choices) > 40 else "")
        self.message = f"unknown {kind} {name!r}.{hint} Choices: {shown or '(none)'}"
        super().__init__(self.message)

    def __str__(self) -> str:
        return self.message


class UnknownKeywordError(GreenhouseError, TypeError):
    """A call uses an unknown keyword; the message lists the valid ones."""


class EpisodeOverError(GreenhouseError, RuntimeError):
    """An environment was stepped after the end of its episode."""


class NoEpisodeError(GreenhouseError, RuntimeError):
    """An environment was used before its first reset."""


class FileFormatError(GreenhouseError, ValueError):
    """A file is missing, damaged, or does not follow its format."""

    def __init__(self, path: object, problem: str):
        self.path = path
        shown = problem if len(problem) <= _LONGEST else problem[:_LONGEST] + "..."
        super().__init__(f"{path}: {shown}")


class FileWriteError(GreenhouseError, OSError):
    """A file could not be written; its previous content is unharmed."""

    def __init__(self, path: object, error: OSError):
        self.path = path
        super().__init__(f"{path}: cannot be written ({error.strerror or error})")


class DivergedError(GreenhouseError, ArithmeticError):
    """A training diverged: its weights are not finite or explode; the message names the checkpoint that is kept."""


class MissingDependencyError(GreenhouseError, ImportError):
    """An optional dependency is not installed or cannot be imported; the message names the extra that installs it."""

    def __init__(self, package: str, extra: str, problem: str = ""):
        what = f"cannot be imported ({problem}); it comes with" if problem else "is not installed:"
        super().__init__(f"{package} {what} pip install 'greenhouse-gym[{extra}]'")


class GrowthError(GreenhouseError):
    """A plant could not be grown, or lacks organs that a row needs; the message gives the reason."""


class CameraError(GreenhouseError):
    """A camera is missing, cannot be started, or no longer delivers images."""


class ReconstructionError(GreenhouseError):
    """A recording could not be turned into a row; the message gives the reasons."""


class NoPlacementError(InvalidValueError):
    """The arm finds no room in front of a row; the message names the settings that move it."""


def require_choice(kind: str, name: str, choices: Iterable[str]) -> str:
    """Return ``name`` if it is among ``choices``, else raise `UnknownNameError` listing them."""
    choices = tuple(choices)
    if not isinstance(name, str) or name not in choices:
        raise UnknownNameError(kind, name, choices)
    return name


def require_seed(seed: int) -> int:
    """Return ``seed`` if it is a non-negative integer, else raise `InvalidValueError`."""
    if isinstance(seed, bool) or not isinstance(seed, Integral) or seed < 0:
        raise InvalidValueError(f"seed must be a whole number from 0 on, got {seed!r}")
    return int(seed)


def check_whole(name: str, value: Any, lowest: int, highest: int | None = None) -> int:
    """Return the value if it is a whole number in the range.

    Raises:
        InvalidValueError: It is not.
    """
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or value < lowest or (highest is not None and value > highest):
        limit = "up" if highest is None else f"to {highest}"
        raise InvalidValueError(f"{name} must be a whole number from {lowest} {limit}, got {value!r}")
    return int(value)


def check_flag(name: str, value: Any) -> bool:
    """Return the value if it is a truth value, of Python or NumPy.

    Raises:
        InvalidValueError: It is not.
    """
    if not isinstance(value, bool | np.bool_):
        raise InvalidValueError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def check_items(name: str, values: Any, expected: str) -> tuple[Any, ...]:
    """Return the items of an iterable.

    Raises:
        InvalidValueError: It is none.
    """
    try:
        return tuple(values)
    except TypeError as error:
        raise InvalidValueError(f"{name} must be {expected}, got {values!r}") from error


def is_number(value: object) -> bool:
    """Return whether a value is a finite real number and not a boolean."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # a whole number beyond the range of floats
        return False
