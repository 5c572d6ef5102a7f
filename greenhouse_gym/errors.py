"""The package's errors: each names the value or file at fault, what was expected and the valid choices."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class GreenhouseError(Exception):
    """Base of every error this package raises on purpose."""


class InvalidValueError(GreenhouseError, ValueError):
    """A value is outside what is allowed."""


class UnknownNameError(GreenhouseError, KeyError):
    """A name is not among the known ones; the message lists them."""

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
    """A call names a keyword that does not exist; the message lists those that do."""


class EpisodeOverError(GreenhouseError, RuntimeError):
    """An environment was stepped after its episode's end."""


class NoEpisodeError(GreenhouseError, RuntimeError):
    """An environment was asked about an episode before its first reset."""


class FileFormatError(GreenhouseError, ValueError):
    """A file is missing, damaged, or does not hold what its format promises."""

    def __init__(self, path: object, problem: str):
        self.path = path
        super().__init__(f"{path}: {problem}")


class FileWriteError(GreenhouseError, OSError):
    """A file could not be written; what was there before is unharmed."""

    def __init__(self, path: object, error: OSError):
        self.path = path
        super().__init__(f"{path}: cannot be written ({error.strerror or error})")


class MissingDependencyError(GreenhouseError, ImportError):
    """An optional dependency is not installed; the message names the extra that brings it."""

    def __init__(self, package: str, extra: str):
        super().__init__(f"{package} is not installed: pip install 'greenhouse-gym[{extra}]'")


class GrowthError(GreenhouseError):
    """A plant could not be grown, or grew without what a row needs; the message gives the reason."""


class ReconstructionError(GreenhouseError):
    """A recording could not be turned into a row; the message gives the reasons."""


def require_choice(kind: str, name: str, choices: Iterable[str]) -> str:
    """Return ``name`` if it is among ``choices``, else raise `UnknownNameError` listing them."""
    choices = tuple(choices)
    if name not in choices:
        raise UnknownNameError(kind, name, choices)
    return name
