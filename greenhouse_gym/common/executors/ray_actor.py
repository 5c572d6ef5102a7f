"""An object that a process of a Ray cluster keeps between calls."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

from greenhouse_gym.common.executors.ray_executor import RayExecutor, match_caller, reason_of, with_node_name
from greenhouse_gym.common.executors.spreading import WorkerLostError


class RayActor:
    """An object in a process of its own on a cluster; it ends with `end`, or with the caller.

    Args:
        cluster: The cluster.
        make: A class, or a function of a module, that makes the object there.
        arguments: What it is made of.
        cpus: Cores that it takes.
    """

    def __init__(self, cluster: RayExecutor, make: Callable[..., object], *arguments: Any, cpus: int = 1):
        self._ray = cluster.ray
        keeper = self._ray.remote(_Keeper).options(num_cpus=cpus, scheduling_strategy="SPREAD")
        self._keeper = keeper.remote(cluster.message(make, *arguments), *cluster.home())

    def ask(self, method: str, *arguments: Any) -> Callable[[], Any]:
        """Have a method of the object called.

        Returns:
            What waits for the answer and gives it. It raises what the method, or the making of the object, raised, and
            `WorkerLostError` where the process is gone.
        """
        reference = self._keeper.answer.remote(method, pickle.dumps(arguments, protocol=4))
        return lambda: self._answer(reference)

    def end(self) -> None:
        """End the process."""
        self._ray.kill(self._keeper)

    def _answer(self, reference: Any) -> Any:
        try:
            went_well, message = self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            raise WorkerLostError(f"a process of the cluster was lost: {reason_of(error)}") from None
        answer = pickle.loads(message)
        if not went_well:
            raise answer
        return answer


class _Keeper:
    """What keeps the object, on a node."""

    def __init__(self, message: bytes, folder: str, path: list[str], version: str):
        self._kept: Any = None
        self._failed: Exception | None = None
        try:
            match_caller(folder, path, version)
            make, arguments, _ = pickle.loads(message)
            self._kept = make(*arguments)
        except Exception as error:
            self._failed = error

    def answer(self, method: str, arguments: bytes) -> tuple[bool, bytes]:
        """Whether a call went well, and the pickled answer or error."""
        try:
            if self._failed is not None:
                raise self._failed
            return True, pickle.dumps(getattr(self._kept, method)(*pickle.loads(arguments)), protocol=4)
        except Exception as error:
            return False, pickle.dumps(with_node_name(error))
