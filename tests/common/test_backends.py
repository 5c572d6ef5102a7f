"""Executors by name, and which one a command takes."""

from __future__ import annotations

import os
from typing import Any

import pytest

from greenhouse_gym.cli.options import executor_of
from greenhouse_gym.common import executors as parallel
from greenhouse_gym.common.executors import RayExecutor, executor_for, ray_executor, workers_of
from greenhouse_gym.errors import MissingDependencyError, UnknownNameError


def test_backends_by_name() -> None:
    with executor_for("serial") as executor:
        assert executor is None
    with executor_for("processes", 3) as executor:
        assert executor.submit(os.getpid).result() != os.getpid()
        assert workers_of(executor) == 3
    with pytest.raises(UnknownNameError, match="Choices: serial, processes, ray"), executor_for("threads"):
        pass


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(ray_executor, "import_module", missing)
    with pytest.raises(MissingDependencyError, match=r"ray is not installed.*greenhouse-gym\[cluster\]"):
        RayExecutor()


@pytest.mark.parametrize(
    ("given", "idle", "expected"),
    [
        ((None, None, "local", 12), 4, "processes"),
        ((None, None, "local", 12), 1, "serial"),  # others are at work here
        ((None, None, "local", 1), 4, "serial"),
        ((None, 2, "local", 1), 0, "processes"),
        ((None, None, "10.0.0.1:6379", 1), 4, "ray"),
        (("serial", 2, "local", 12), 4, "serial"),
    ],
)
def test_commands_take_processes_where_cores_are_idle(
    given: tuple[Any, ...], idle: int, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "idle_cores", lambda: idle)
    monkeypatch.setattr(parallel, "executor_for", lambda backend, workers, address: backend)
    assert executor_of(*given) == expected  # type: ignore[comparison-overlap]
