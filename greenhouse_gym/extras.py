"""Optional dependencies: what is missing is told by the extra of this package that brings it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from greenhouse_gym.errors import MissingDependencyError


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


def require_installed(extra: str, *modules: str) -> None:
    """Raise `MissingDependencyError` for the first of the modules that is not installed, without importing any."""
    for module in modules:
        if find_spec(module) is None:
            raise MissingDependencyError(module, extra)


def _interrupted(error: BaseException | None) -> bool:
    while error is not None and not isinstance(error, KeyboardInterrupt):
        if "KeyboardInterrupt" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return error is not None
