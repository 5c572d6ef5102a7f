"""Calls that may take only so long."""

from __future__ import annotations

from collections.abc import Callable
from queue import Empty, SimpleQueue
from threading import Thread
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class Deadline:
    """Makes calls and waits only so long for each; after one that took longer, every call fails at once.

    A call that hangs goes on in a thread of its own, which cannot be ended: what it works on is not to be used again.

    Args:
        seconds: How long a call may take; None waits for ever.
    """

    def __init__(self, seconds: float | None = None):
        self._seconds = seconds
        self._over = ""

    @property
    def expired(self) -> bool:
        """Whether a call took too long."""
        return bool(self._over)

    def call(self, function: Callable[P, T], *arguments: P.args, **keywords: P.kwargs) -> T:
        """The function's result.

        Raises:
            TimeoutError: It took too long, or an earlier call did.
        """
        if self._seconds is None:
            return function(*arguments, **keywords)
        if self._over:
            raise TimeoutError(self._over)
        answers: SimpleQueue[tuple[T | None, BaseException | None]] = SimpleQueue()

        def work() -> None:
            try:
                answers.put((function(*arguments, **keywords), None))
            except BaseException as error:  # told to the caller
                answers.put((None, error))

        Thread(target=work, daemon=True).start()
        try:
            result, error = answers.get(timeout=self._seconds)
        except Empty:
            self._over = f"it took longer than {self._seconds:g} s"
            raise TimeoutError(self._over) from None
        if error is not None:
            raise error
        return result  # type: ignore[return-value]
