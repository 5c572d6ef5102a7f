"""Function calls with a time limit."""

from __future__ import annotations

import os
from collections.abc import Callable
from queue import Empty, SimpleQueue
from threading import TIMEOUT_MAX, Thread
from typing import ParamSpec, TypeVar

from greenhouse_gym.errors import InvalidValueError, is_number

MAX_MESSAGE = 1000
"""Number of characters of an error's message that records hold."""

P = ParamSpec("P")
T = TypeVar("T")


class Deadline:
    """Runs calls with a time limit each. After the first timeout, every further call fails at once.

    Each call runs in a thread of its own. A thread cannot be killed, so a call that hangs keeps running: discard the
    object that it works on.

    A call that tries to end the process, as `sys.exit` does, fails instead. If a call forks, the copies of the process
    end where it returns.

    Args:
        seconds: Time limit of a call; None for no limit.

    Raises:
        InvalidValueError: The limit is not a positive, finite number that the system's clock can hold.
    """

    def __init__(self, seconds: float | None = None):
        if seconds is not None and not (is_number(seconds) and 0 < seconds <= TIMEOUT_MAX):
            raise InvalidValueError(
                f"timeout must be a positive number of seconds up to {TIMEOUT_MAX:.2g}, or None, got {seconds!r}"
            )
        self._seconds = None if seconds is None else float(seconds)
        self._timeout_message = ""

    @property
    def expired(self) -> bool:
        """True once a call has timed out."""
        return bool(self._timeout_message)

    def call(self, function: Callable[P, T], *arguments: P.args, **keywords: P.kwargs) -> T:
        """Return the function's result.

        Raises:
            TimeoutError: This call or an earlier one timed out.
            RuntimeError: The call raised something else than an `Exception`, such as `SystemExit`.
        """
        process = os.getpid()

        def work() -> T:
            try:
                return function(*arguments, **keywords)
            except (Exception, KeyboardInterrupt):  # Ctrl-C
                raise
            except BaseException as error:
                raise RuntimeError(describe(error)) from error
            finally:
                if os.getpid() != process:
                    os._exit(1)

        if self._seconds is None:
            return work()
        if self._timeout_message:
            raise TimeoutError(self._timeout_message)
        answers: SimpleQueue[tuple[T | None, BaseException | None]] = SimpleQueue()

        def answer() -> None:
            try:
                answers.put((work(), None))
            except BaseException as error:  # raised again in the caller's thread
                answers.put((None, error))

        Thread(target=answer, daemon=True).start()
        try:
            result, error = answers.get(timeout=self._seconds)
        except Empty:
            self._timeout_message = f"timed out after {self._seconds:g} s"
            raise TimeoutError(self._timeout_message) from None
        if error is not None:
            raise error
        return result  # type: ignore[return-value]


def describe(error: BaseException) -> str:
    """Return an error's type and message as text that can be printed and stored, whatever the message is."""
    try:
        message = str(error)
    except (Exception, SystemExit):
        message = "its message cannot be printed"
    return printable(f"{type(error).__name__}: {message}")


def printable(text: str) -> str:
    """Return a text of bounded length without characters that cannot be encoded."""
    return text[:MAX_MESSAGE].encode(errors="replace").decode()
