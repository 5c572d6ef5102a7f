"""An executor that is as strict as one on another machine."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any


class Elsewhere(Executor):
    """Works in this process, but on nothing that did not travel there and back."""

    def __init__(self) -> None:
        self.works: list[str] = []

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **keywords: Any) -> Future[Any]:
        future = Future[Any]()
        called, given, named = pickle.loads(pickle.dumps((function, arguments, keywords)))
        self.works.append(called.__name__)
        try:
            future.set_result(pickle.loads(pickle.dumps(called(*given, **named))))
        except BaseException as error:
            future.set_exception(pickle.loads(pickle.dumps(error)))
        return future
