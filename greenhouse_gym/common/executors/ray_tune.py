"""Pieces of work that tell how they are going, each a trial of Ray Tune, which starts, watches and ends them.

A piece is a function of its item and of what it tells its figures to. It keeps what it has done itself, in a place that
all nodes see, and goes on from there when it is begun anew: Tune's own folders of trials lie on the nodes until it
copies them, so what is in them is gone with the node.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeVar

from greenhouse_gym.common.executors.ray_executor import RayExecutor, at_home, told
from greenhouse_gym.common.executors.spreading import WorkerLostError
from greenhouse_gym.common.extras import needs

with needs("cluster"):
    from ray import tune
    from ray.tune.schedulers import ASHAScheduler

Item = TypeVar("Item")
Result = TypeVar("Result")

Tell = Callable[[Mapping[str, float], Any], None]
"""Takes the figures of a piece of work so far, and what its result is should it be ended here; to end it, raises
`KeyboardInterrupt`."""

FOLDER = "tune"
"""Where Tune keeps its own files, below the folder of the work."""

_ITEM, _RESULT, _RAISED, _WHOLE = "item", "result", "raised", "whole"
_SETTINGS = {
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",  # the work keeps its own curves
    "TUNE_DISABLE_STRICT_METRIC_CHECKING": "1",  # work that fails before its first figures has none
    "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",  # errors are told by the results
    "RAY_AIR_NEW_OUTPUT": "0",  # which cannot be silent
}
_TALKING = (
    "ray.tune.tune",
    "ray.tune.analysis.experiment_analysis",
)  # loggers that tell of trials and how to restore them


@dataclass(frozen=True)
class Halving:
    """When to end work that falls behind, by asynchronous successive halving.

    What reaches an eighth, a quarter or a half of the whole is ended there if its measure is below the median of those
    that came there before.

    Attributes:
        measure: The figure by which they are compared; more is better.
        clock: The figure that tells how far they are.
        whole: How far the longest goes.
    """

    measure: str
    clock: str
    whole: int

    def scheduler(self) -> ASHAScheduler:
        """Tune's scheduler that does so."""
        first = max(1, self.whole // 8)
        return ASHAScheduler(
            self.clock, self.measure, "max", max_t=4 * first, grace_period=first, reduction_factor=2,
            stop_last_trials=False,
        )  # fmt: skip


def run_trials(
    work: Callable[[Item, Tell], Result],
    items: Mapping[str, Item],
    cluster: RayExecutor,
    folder: Path,
    on_end: Callable[[str, Result | WorkerLostError, bool], None],
    on_told: Callable[[Result], None] = lambda result: None,
    halving: Halving | None = None,
) -> None:
    """Have each item worked on in a process of the cluster, as many at a time as that has room for.

    Args:
        work: What is done to an item; a function of a module.
        items: The items, by their names.
        cluster: The cluster; each piece takes the cores and the memory that it gives to a piece, and is begun anew as
            often as it says when its process or node dies.
        folder: Tune's files get a folder in it.
        on_end: Told the name of each item that is over with, what came of it, and whether it was ended early.
        on_told: Told the result that a piece of work has till then, each time it tells its figures.
        halving: Which to end early; None ends none.

    Raises:
        KeyboardInterrupt: The work was interrupted; each piece had a few seconds to end itself.
        Exception: What a piece of work or ``on_end`` raised first, a `RuntimeError` where that is no `Exception`, such
            as `SystemExit`; the others were ended.
    """
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    watch = _Watch(on_end, on_told)
    trial = tune.with_parameters(_Trial, message=cluster.message(work, dict(items)), home=cluster.home())
    room = {"cpu": cluster.cpus, **({} if cluster.memory is None else {"memory": cluster.memory})}
    tuner = tune.Tuner(
        tune.with_resources(trial, room),
        param_space={_ITEM: tune.grid_search(list(items))},
        tune_config=tune.TuneConfig(
            scheduler=halving and halving.scheduler(),
            reuse_actors=True,
            trial_name_creator=_name_of,
            trial_dirname_creator=_name_of,
        ),
        run_config=tune.RunConfig(
            name=FOLDER,
            storage_path=str(folder.resolve()),
            failure_config=tune.FailureConfig(max_failures=cluster.retries),
            checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
            callbacks=[watch],
            verbose=0,
        ),
    )
    with _quiet(), _interruptions_kept():
        tuner.fit()
    if watch.ended < len(items):  # Tune takes Ctrl-C for itself, and returns
        raise KeyboardInterrupt


class _Trial(tune.Trainable):  # type: ignore[misc]
    """A piece of work, in a thread that waits at all it tells until Tune asks for more."""

    def setup(self, config: dict[str, Any], message: bytes, home: tuple[str, list[str], str]) -> None:
        self._message, self._home = message, home
        self._begin(config[_ITEM])

    def reset_config(self, new_config: dict[str, Any]) -> bool:
        self.cleanup()
        self._begin(new_config[_ITEM])
        return True

    def step(self) -> dict[str, Any]:
        self._turns.put(True)
        line = self._told.get()
        if isinstance(line, Exception):
            return {_RAISED: pickle.dumps(told(line)), "done": True}
        return line

    def cleanup(self) -> None:
        self._turns.put(False)
        self._thread.join()

    def _begin(self, name: str) -> None:
        self._told, self._turns = SimpleQueue[dict[str, Any] | Exception](), SimpleQueue[bool]()
        self._thread = threading.Thread(target=self._work, args=(name,), daemon=True)
        self._thread.start()

    def _work(self, name: str) -> None:
        try:
            self._wait()
            at_home(*self._home)
            work, (items,), _ = pickle.loads(self._message)
            self._told.put({_RESULT: work(items[name], self._tell), _WHOLE: True, "done": True})
        except Exception as error:
            self._told.put(error)
        except BaseException as error:  # nobody asks any more after an interruption of `_wait`; else `step` waits
            self._told.put(RuntimeError(f"a piece of work ended by {type(error).__name__}: {error}"))

    def _tell(self, figures: Mapping[str, float], result: Any) -> None:
        known = {name: figure for name, figure in figures.items() if isfinite(figure)}  # others cannot be compared
        self._told.put({**known, _RESULT: result})
        self._wait()

    def _wait(self) -> None:
        if not self._turns.get():
            raise KeyboardInterrupt


class _Watch(tune.Callback):  # type: ignore[misc]
    """Hands on what Tune tells, between its steps, where an error ends the run."""

    def __init__(self, on_end: Callable[[str, Any, bool], None], on_told: Callable[[Any], None]):
        self.ended = 0
        self._on_end, self._on_told = on_end, on_told
        self._due: list[Callable[[], None]] = []

    def __getstate__(self) -> dict[str, Any]:
        return {}  # Tune writes what it is given to a file; what is called back stays here

    def on_trial_result(self, result: dict[str, Any], **_: Any) -> None:
        if not result["done"]:
            self._due.append(lambda: self._on_told(result[_RESULT]))

    def on_trial_complete(self, trial: Any, **_: Any) -> None:
        self._due.append(lambda: self._end(trial, trial.last_result))

    def on_trial_error(self, trial: Any, **_: Any) -> None:
        where = f"{FOLDER}/{_name_of(trial)}/error.txt"
        lost = WorkerLostError(
            f"its process or node died, or could not begin or hand on the work, {trial.num_failures} times "
            f"({where} tells more)"
        )
        self._due.append(lambda: self._end(trial, {_RESULT: lost, _WHOLE: True}))

    def on_step_end(self, **_: Any) -> None:
        due, self._due = self._due, []
        for call in due:
            call()

    def _end(self, trial: Any, last: dict[str, Any]) -> None:
        self.ended += 1
        if _RAISED in last:
            raise pickle.loads(last[_RAISED])
        self._on_end(_name_of(trial), last[_RESULT], _WHOLE not in last)


def _name_of(trial: Any) -> str:
    return str(trial.config[_ITEM])


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what Tune says of trials: what is called back says it."""
    levels = {logger: logger.level for logger in map(logging.getLogger, _TALKING)}
    try:
        for logger in levels:
            logger.setLevel(logging.CRITICAL)
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


@contextmanager
def _interruptions_kept() -> Iterator[None]:
    """Put back what is done on Ctrl-C, which Tune changes for good."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
