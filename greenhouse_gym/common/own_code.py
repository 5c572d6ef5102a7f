"""Objects from a user's own Python code, named as ``"file.py:name"`` or ``"module:name"``, and back.

Settings name such objects by text, so that they can be written to files and sent to other processes. An instance of a
dataclass is a mapping: its class, by name, under the key ``class``, and its fields.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from pydantic import PydanticUserError, TypeAdapter, ValidationError

from greenhouse_gym.common.files import first_fault
from greenhouse_gym.errors import FileFormatError, GreenhouseError, InvalidValueError, UnknownNameError

CLASS = "class"
"""Key of the class in the mapping of an instance."""

MAX_MESSAGE = 1000
"""Number of characters of an error's message that records hold."""


@contextmanager
def failing_as(error_of: Callable[[str], GreenhouseError]) -> Iterator[None]:
    """Turn whatever a user's code raises, `SystemExit` included, into an error of the package.

    Args:
        error_of: Makes the error of the description of the user's.
    """
    try:
        yield
    except (GreenhouseError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise error_of(describe(error)) from error


def describe(error: BaseException) -> str:
    """Return an error's type and message as text that can always be printed and stored."""
    try:
        message = str(error) or ("there is not enough memory" if isinstance(error, MemoryError) else "")
    except (Exception, SystemExit):
        message = "its message cannot be printed"
    return printable(f"{type(error).__name__}: {message}")


def printable(text: str) -> str:
    """Return a text of bounded length without characters that cannot be encoded."""
    return text[:MAX_MESSAGE].encode(errors="replace").decode()


def is_own(choice: object) -> bool:
    """Return whether a setting names an object of the user's own code: a reference or the mapping of an instance."""
    return isinstance(choice, Mapping) or (isinstance(choice, str) and (":" in choice or choice.endswith(".py")))


def with_absolute_path(choice: Any) -> Any:
    """Return a reference with the absolute path of its file, valid in every folder; any other choice unchanged."""
    if isinstance(choice, Mapping) and CLASS in choice:
        return {**choice, CLASS: with_absolute_path(choice[CLASS])}
    file, _, name = choice.rpartition(":") if isinstance(choice, str) else ("", "", "")
    return f"{Path(file).resolve()}:{name}" if file.endswith(".py") else choice


def load_own(choice: Any, kind: str, is_candidate: Callable[[object], bool] = callable) -> Any:
    """Return the object that a reference or the mapping of an instance names; any other choice unchanged.

    Args:
        choice: ``"file.py:name"``, ``"module:name"``, or a mapping with ``class``, such a reference, and its arguments.
        kind: Kind of the object, for messages.
        is_candidate: Selects the objects of the module that a message about an unknown name lists.

    Raises:
        InvalidValueError: The module cannot be imported, or the class does not take the arguments.
        FileFormatError: The file does not exist or cannot be run.
        UnknownNameError: The module has no object of that name.
    """
    if not is_own(choice):
        return choice
    if isinstance(choice, str):
        return _load(choice, kind, is_candidate)
    if not isinstance(choice.get(CLASS), str):
        raise InvalidValueError(f'{kind} must name its class, as {{"{CLASS}": "file.py:Name", ...}}, got {choice!r}')
    return make(_load(choice[CLASS], kind, is_candidate), choice[CLASS], {k: choice[k] for k in choice if k != CLASS})


def make(found: Any, reference: str, arguments: Mapping[str, Any]) -> Any:
    """Return the instance of a class with arguments, which have the types of its fields if it is a dataclass.

    Raises:
        InvalidValueError: It does not take the arguments.
    """
    given = f"with arguments {dict(arguments)}" if arguments else "without arguments"
    with failing_as(lambda problem: InvalidValueError(f"{reference} cannot be made {given}: {problem}")):
        try:
            if is_dataclass(found):
                with suppress(PydanticUserError):  # types unknown to pydantic, or of a file's own names
                    return TypeAdapter(found).validate_python(arguments)
            return found(**arguments)
        except ValidationError as error:
            raise InvalidValueError(f"{reference}: {first_fault(error)}") from error


def described(own: Any) -> Any:
    """Return a choice as a JSON value: a name, a reference, or the mapping of an instance.

    An object that only exists in this process, such as a lambda, is returned unchanged.
    """
    if is_own(own):
        return with_absolute_path(own)
    if own is None or isinstance(own, str | int | float):
        return own
    if reference := _reference_to(own):
        return reference
    if kind := "" if isinstance(own, type) else _reference_to(type(own)):
        with suppress(TypeError, ValueError):
            if is_dataclass(own) and not isinstance(own, type):
                return {CLASS: kind, **json.loads(json.dumps(asdict(own), allow_nan=False))}
            if not vars(own):
                return {CLASS: kind}
    return own


def portable(own: Any, kind: str) -> Any:
    """Return a choice as a JSON value, like `described`.

    Raises:
        InvalidValueError: It only exists in this process.
    """
    found = described(own)
    if found is own and not isinstance(own, str | Mapping):
        raise InvalidValueError(
            f"{kind} must have a name at the top of a module or script, or be a dataclass, so that files and other "
            f"processes can name it, got {own!r}"
        )
    return found


def _reference_to(own: Any) -> str:
    """Return the reference to a function, class or other object at the top of a module; empty if it is not there."""
    module = getattr(own, "__module__", type(own).__module__)
    names = vars(sys.modules[module]) if module in sys.modules else getattr(own, "__globals__", {})
    name = next((name for name, value in names.items() if value is own and name.isidentifier()), "")
    file = names.get("__file__")
    # a script, or a module that others would not find by its name
    alone = module == "__main__" or ("." not in module and PathFinder.find_spec(module) is None)
    return "" if not name else f"{Path(file).resolve()}:{name}" if alone and file else f"{module}:{name}"


def _load(reference: str, kind: str, is_candidate: Callable[[object], bool]) -> Any:
    if reference.endswith(".py"):
        loaded = _from_file(reference, kind)
        own = [name for name, value in vars(loaded).items() if getattr(value, "__module__", "") == loaded.__name__]
        names = [name for name in own if is_candidate(getattr(loaded, name))] or ["Name"]
        examples = " or ".join(f"{reference}:{name}" for name in names)
        raise InvalidValueError(f"{reference}: name the {kind} in this file as well, such as {examples}")
    module, _, attribute = reference.rpartition(":")
    if not module or not attribute.isidentifier():
        raise InvalidValueError(f'{kind}: expected "file.py:Name" or "module:Name", got {reference!r}')
    loaded = _from_file(module, kind) if module.endswith(".py") else _from_path(module)
    if not hasattr(loaded, attribute):
        candidates = [name for name, value in vars(loaded).items() if is_candidate(value)]
        raise UnknownNameError(f"{kind} in {module}", attribute, candidates)
    return getattr(loaded, attribute)


def _from_path(module: str) -> ModuleType:
    _find_modules_in(Path.cwd())  # a command does not look there by itself
    with failing_as(lambda problem: InvalidValueError(f"module {module!r} cannot be imported: {problem}")):
        return importlib.import_module(module)


def _from_file(file: str, kind: str) -> ModuleType:
    path = Path(file)
    if not path.is_file():
        raise FileFormatError(file, f"there is no such file; expected Python code with the {kind}")
    script = sys.modules["__main__"]
    if path.resolve() == Path(getattr(script, "__file__", None) or "").resolve():
        return script  # running it again would start over
    _find_modules_in(path.resolve().parent)
    spec = importlib.util.spec_from_file_location("own_code", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # only while it runs: dataclasses look it up, but workers could not import it
    try:
        with failing_as(lambda problem: FileFormatError(file, f"cannot be run: {problem}")):
            spec.loader.exec_module(module)
    finally:
        del sys.modules[spec.name]
    return module


def _find_modules_in(folder: Path) -> None:
    """Let own code import the modules next to it, after all others."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
