"""Options by which a command's work is spread over cores or machines."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from concurrent.futures import Executor

Backend = Annotated[
    str | None,
    typer.Option(
        help="Where the work is done: serial, processes or ray; the results are the same.", show_default=False
    ),
]
Address = Annotated[str, typer.Option(help="With ray: local, auto, or HOST:PORT of a cluster's head.")]
Workers = Annotated[
    int | None, typer.Option(min=1, help="Processes on this machine; one per core by default.", show_default=False)
]


def spread(
    backend: str | None, workers: int | None, address: str, pieces: int = 1
) -> AbstractContextManager[Executor | None]:
    """The executor that a command's options ask for.

    Without a backend, processes are taken where they are asked for by their number, or where there are several pieces
    of work and idle cores; a Ray cluster where its address is given.
    """
    from greenhouse_gym.common.executors import executor_for, idle_cores

    if backend is None:
        many = workers is not None or (pieces > 1 and idle_cores() > 1)
        backend = "ray" if address != "local" else "processes" if many else "serial"
    return executor_for(backend, workers, address)
