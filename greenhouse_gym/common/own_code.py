"""Loading of objects from a user's own Python code, named as ``"file.py:Name"`` or ``"module:Name"``."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError


def load_object(reference: str, kind: str, is_candidate: Callable[[object], bool]) -> Any:
    """Load an object from a file or module; if it is a class, return an instance of it.

    Args:
        reference: ``"file.py:Name"`` or ``"module:Name"``.
        kind: Kind of the object, for messages.
        is_candidate: Selects the objects of the module that a message about an unknown name lists.

    Raises:
        InvalidValueError: The module cannot be imported, or the class needs arguments.
        FileFormatError: The file does not exist or cannot be run.
        UnknownNameError: The module has no object of that name.
    """
    module, _, attribute = reference.rpartition(":")
    loaded = _from_file(module, kind) if module.endswith(".py") else _from_path(module)
    if not hasattr(loaded, attribute):
        candidates = [name for name, value in vars(loaded).items() if is_candidate(value)]
        raise UnknownNameError(f"{kind} in {module}", attribute, candidates)
    found = getattr(loaded, attribute)
    try:
        return found() if isinstance(found, type) else found
    except TypeError as error:
        raise InvalidValueError(f"{reference} cannot be made without arguments: {error}") from error


def _from_path(module: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except (ImportError, ValueError) as error:
        raise InvalidValueError(f"module {module!r} cannot be imported: {error}") from error


def _from_file(file: str, kind: str) -> ModuleType:
    path = Path(file)
    if not path.is_file():
        raise FileFormatError(file, f"there is no such file; expected Python code with the {kind}")
    spec = importlib.util.spec_from_file_location("own_code", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # only while it runs: dataclasses look it up, but workers could not import it
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # any error in the user's code
        raise FileFormatError(file, f"cannot be run: {type(error).__name__}: {error}") from error
    finally:
        del sys.modules[spec.name]
    return module
