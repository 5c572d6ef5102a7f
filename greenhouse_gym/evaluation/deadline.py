"""Function calls with a time limit."""

from __future__ import annotations

from collections.abc import Callable
from queue import Empty, SimpleQueue
from threading import Thread
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class Deadline:
    """Runs calls with a time limit each. After the first timeout, every further call fails at once.

    Each call runs in a thread of its own. A thread cannot be killed, so a call that hangs keeps running: discard the
    object that it works on.

    Args:
        seconds: Time limit of a call; None for no limit.
    """

    def __init__(self, seconds: float | None = None):
        self._seconds = seconds
        self._timeout_message = ""

    @property
    def expired(self) -> bool:
        """True once a call has timed out."""
        return bool(self._timeout_message)

    def call(self, function: Callable[P, T], *arguments: P.args, **keywords: P.kwargs) -> T:
        """Return the function's result.

        Raises:
            TimeoutError: This call or an earlier one timed out.
        """
        if self._seconds is None:
            return function(*arguments, **keywords)
        if self._timeout_message:
            raise TimeoutError(self._timeout_message)
        answers: SimpleQueue[tuple[T | None, BaseException | None]] = SimpleQueue()

        def work() -> None:
            try:
                answers.put((function(*arguments, **keywords), None))
            except BaseException as error:  # raised again in the caller's thread
                answers.put((None, error))

        Thread(target=work, daemon=True).start()
        try:
            result, error = answers.get(timeout=self._seconds)
        except Empty:
            self._timeout_message = f"timed out after {self._seconds:g} s"
            raise TimeoutError(self._timeout_message) from None
        if error is not None:
            raise error
        return result  # type: ignore[return-value]
