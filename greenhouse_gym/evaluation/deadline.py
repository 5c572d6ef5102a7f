"""Calls of foreign code with limits on time and memory, and the questions of an evaluation, which are asked once."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from queue import Empty, SimpleQueue
from threading import TIMEOUT_MAX, Thread
from types import MappingProxyType
from typing import Any, ParamSpec, TypeVar

from greenhouse_gym.agents.agent import Agent, knows_scene, knows_truth, own_options
from greenhouse_gym.agents.named import agent_of
from greenhouse_gym.common.own_code import describe, printable
from greenhouse_gym.errors import GreenhouseError, InvalidValueError, is_number

_FREE = nullcontext()
_SECONDS_TO_END = 1.0

P = ParamSpec("P")
T = TypeVar("T")


class Deadline:
    """Runner of calls with a time limit each. After the first timeout, every further call fails at once.

    Each call runs in a thread of its own. When it times out, a `SystemExit` is raised at its next step of Python. If it
    takes no such step, or catches the error, it keeps running: discard the object that it works on.

    A call that tries to end the process, as `sys.exit` does, fails instead. If a call forks, the copies of the process
    end where it returns.

    Args:
        seconds: Time limit of a call; None for no limit.
        memory: Context of each call that limits its memory.
        watchdog: Context that waits for it.

    Raises:
        InvalidValueError: The limit is not a positive, finite number that the system's clock can hold.
    """

    def __init__(
        self,
        seconds: float | None = None,
        memory: AbstractContextManager[None] = _FREE,
        watchdog: AbstractContextManager[None] = _FREE,
    ):
        if seconds is not None and not (is_number(seconds) and 0 < seconds <= TIMEOUT_MAX):
            raise InvalidValueError(
                f"timeout must be a positive number of seconds up to {TIMEOUT_MAX:.2g}, or None, got {seconds!r}"
            )
        self._seconds = None if seconds is None else float(seconds)
        self._memory, self._watchdog = memory, watchdog
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
                with self._memory:  # a thread that lacks the memory to begin never answers
                    return function(*arguments, **keywords)
            except (Exception, KeyboardInterrupt):  # Ctrl-C
                raise
            except BaseException as error:
                raise RuntimeError(describe(error)) from error
            finally:
                if os.getpid() != process:
                    os._exit(1)

        if self._timeout_message:
            raise TimeoutError(self._timeout_message)
        with self._watchdog:
            return work() if self._seconds is None else self._in_thread(work)

    def _in_thread(self, work: Callable[[], T]) -> T:
        answers: SimpleQueue[tuple[T | None, BaseException | None]] = SimpleQueue()

        def answer() -> None:
            try:
                answers.put((work(), None))
            except BaseException as error:  # raised again in the caller's thread
                answers.put((None, error))

        thread = Thread(target=answer, daemon=True)
        thread.start()
        try:
            result, error = answers.get(timeout=self._seconds)
        except Empty:
            self._timeout_message = f"timed out after {self._seconds:g} s"
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident or 0), ctypes.py_object(SystemExit))
            thread.join(_SECONDS_TO_END)
            self._memory.__exit__(None, None, None)
            raise TimeoutError(self._timeout_message) from None
        if error is not None:
            raise error
        return result  # type: ignore[return-value]


class Watchdog:
    """Context in which the system ends this process after a time, even if its code lets no other thread run.

    Args:
        seconds: The time.
    """

    def __init__(self, seconds: float):
        self._set = partial(signal.setitimer, signal.ITIMER_REAL) if hasattr(signal, "setitimer") else lambda time: None
        self._seconds = seconds

    def __enter__(self) -> None:
        self._set(self._seconds)

    def __exit__(self, *_: object) -> None:
        self._set(0.0)


class AgentError(GreenhouseError, RuntimeError):
    """Raised for an agent that fails before its first valid action."""


def never_acted(name: str, seed: int, failure: str) -> AgentError:
    """Return the error for an agent that failed before its first action."""
    return AgentError(f"agent {name!r} failed before its first action (seed {seed}): {failure}")


@dataclass(frozen=True)
class AskedAgent:
    """An agent, and its answers to the questions of an evaluation.

    Attributes:
        agent: The agent.
        name: Its name.
        env_options: Keywords that it chooses for the environment.
        knows_truth: True if it declares that it knows the truth.
        knows_scene: False if it declares that it acts on its observation alone.
        acts_on_many: True if it has a method ``act_many``.
    """

    agent: Agent
    name: str
    env_options: Mapping[str, Any]
    knows_truth: bool
    knows_scene: bool
    acts_on_many: bool

    @classmethod
    def of(cls, agent: Agent | str, options: Mapping[str, Any] = MappingProxyType({})) -> AskedAgent:
        """Ask an agent, or an agent by name.

        Args:
            agent: The agent.
            options: Keywords of the environment that the user chooses.

        Raises:
            InvalidValueError: It is not an agent.
            AgentError: It fails to answer.
        """
        agent = agent_of(agent)

        def asked() -> AskedAgent:
            name, own = printable(str.__str__(agent.name)), own_options(agent, options)  # of subclasses, too
            return cls(agent, name, own, knows_truth(agent), knows_scene(agent), hasattr(agent, "act_many"))

        try:
            return Deadline().call(asked)
        except Exception as error:
            kind = type(agent).__name__
            raise AgentError(
                f"agent {kind} failed to say its name, env_options or what it knows: {describe(error)}"
            ) from error
