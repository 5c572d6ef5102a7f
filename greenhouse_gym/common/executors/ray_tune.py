"""Run tasks that report metrics as trials of Ray Tune, which starts, monitors and ends them.

A task is a function of its item and of a callback for its metrics. It keeps its own checkpoints on storage that all
nodes see and resumes from them when it is restarted: Tune's trial folders stay on a node until Tune copies them, and
are lost with the node.
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

from greenhouse_gym.common.executors.ray_executor import RayExecutor, match_caller, with_node_name
from greenhouse_gym.common.executors.spreading import WorkerLostError
from greenhouse_gym.common.extras import needs

with needs("cluster"):
    from ray import tune
    from ray.tune.schedulers import ASHAScheduler

Item = TypeVar("Item")
Result = TypeVar("Result")

OnProgress = Callable[[Mapping[str, float], Any], None]
"""Callback that takes a task's metrics so far and its result in case it ends here; raises `KeyboardInterrupt` to end
the task."""

FOLDER = "tune"
"""Folder of Tune's own files, below the folder of the work."""

_ITEM, _RESULT, _RAISED, _WHOLE = "item", "result", "raised", "whole"
_SETTINGS = {
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",  # tasks keep their own curves
    "TUNE_DISABLE_STRICT_METRIC_CHECKING": "1",  # a task that fails before its first report has no metrics
    "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",  # results carry the errors
    "RAY_AIR_NEW_OUTPUT": "0",  # which cannot be silent
}
_LOGGERS = ("ray.tune.tune", "ray.tune.analysis.experiment_analysis")  # print trials and how to restore them


@dataclass(frozen=True)
class Halving:
    """Rule that ends tasks early by asynchronous successive halving.

    A task that reaches an eighth, a quarter or a half of the whole ends there if its metric is below the median of the
    tasks that reached that point before.

    Attributes:
        measure: Metric to compare; larger is better.
        clock: Metric that counts progress.
        whole: Progress at which the longest task ends.
    """

    measure: str
    clock: str
    whole: int

    def scheduler(self) -> ASHAScheduler:
        """Return Tune's scheduler for this rule."""
        first = max(1, self.whole // 8)
        stops = {"max_t": 4 * first, "grace_period": first, "reduction_factor": 2, "stop_last_trials": False}
        return ASHAScheduler(self.clock, self.measure, "max", **stops)


def run_trials(
    work: Callable[[Item, OnProgress], Result],
    items: Mapping[str, Item],
    cluster: RayExecutor,
    folder: Path,
    on_end: Callable[[str, Result | WorkerLostError, bool], None],
    on_progress: Callable[[Result], None] = lambda result: None,
    halving: Halving | None = None,
) -> None:
    """Run a task for each item in processes of a cluster, as many at a time as fit.

    Args:
        work: Task to run for an item; a function of a module.
        items: The items by name.
        cluster: The cluster; its settings give the cores, the memory and the number of retries of each task.
        folder: Folder below which Tune keeps its files.
        on_end: Called with the name of each finished item, its result, and whether it was ended early.
        on_progress: Called with a task's result so far, each time the task reports its metrics.
        halving: Rule that ends tasks early; None ends none.

    Raises:
        KeyboardInterrupt: The work was interrupted; each task had a few seconds to end itself.
        WorkerLostError: Nodes were lost, and none that is left can run a task.
        Exception: The first error of a task or of ``on_end``; a `RuntimeError` where that is not an `Exception`, such
            as `SystemExit`. The other tasks were ended.
    """
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    watch = _Watch(on_end, on_progress, cluster)
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
    """A task in a thread that waits at each report until Tune requests the next."""

    def setup(self, config: dict[str, Any], message: bytes, home: tuple[str, list[str], str]) -> None:
        self._message, self._home = message, home
        self._begin(config[_ITEM])

    def reset_config(self, new_config: dict[str, Any]) -> bool:
        self.cleanup()
        self._begin(new_config[_ITEM])
        return True

    def step(self) -> dict[str, Any]:
        self._turns.put(True)
        line = self._reports.get()
        if isinstance(line, Exception):
            return {_RAISED: pickle.dumps(with_node_name(line)), "done": True}
        return line

    def cleanup(self) -> None:
        self._turns.put(False)
        self._thread.join()

    def _begin(self, name: str) -> None:
        self._reports, self._turns = SimpleQueue[dict[str, Any] | Exception](), SimpleQueue[bool]()
        self._thread = threading.Thread(target=self._work, args=(name,), daemon=True)
        self._thread.start()

    def _work(self, name: str) -> None:
        try:
            self._wait()
            match_caller(*self._home)
            work, (items,), _ = pickle.loads(self._message)
            self._reports.put({_RESULT: work(items[name], self._report), _WHOLE: True, "done": True})
        except Exception as error:
            self._reports.put(error)
        except BaseException as error:  # after an interruption of `_wait` no one reads this; otherwise `step` waits
            self._reports.put(RuntimeError(f"a task ended by {type(error).__name__}: {error}"))

    def _report(self, metrics: Mapping[str, float], result: Any) -> None:
        finite = {name: value for name, value in metrics.items() if isfinite(value)}  # others cannot be compared
        self._reports.put({**finite, _RESULT: result})
        self._wait()

    def _wait(self) -> None:
        if not self._turns.get():
            raise KeyboardInterrupt


class _Watch(tune.Callback):  # type: ignore[misc]
    """Callback that forwards Tune's events between its steps, where an error can end the run."""

    def __init__(
        self, on_end: Callable[[str, Any, bool], None], on_progress: Callable[[Any], None], cluster: RayExecutor
    ):
        self.ended, self._cluster = 0, cluster
        self._on_end, self._on_progress = on_end, on_progress
        self._due: list[Callable[[], None]] = []

    def __getstate__(self) -> dict[str, Any]:
        return {}  # Tune writes its callbacks to a file; ours cannot be pickled

    def on_trial_result(self, result: dict[str, Any], **_: Any) -> None:
        if not result["done"]:
            self._due.append(lambda: self._on_progress(result[_RESULT]))

    def on_trial_complete(self, trial: Any, **_: Any) -> None:
        self._due.append(lambda: self._end(trial, trial.last_result))

    def on_trial_error(self, trial: Any, **_: Any) -> None:
        where = f"{FOLDER}/{_name_of(trial)}/error.txt"
        lost = WorkerLostError(
            f"its process or node died, or could not start or return the task, {trial.num_failures} times "
            f"(details in {where})"
        )
        self._due.append(lambda: self._end(trial, {_RESULT: lost, _WHOLE: True}))

    def on_step_end(self, **_: Any) -> None:
        due, self._due = self._due, []
        for call in due:
            call()
        if self._cluster.stranded:
            raise WorkerLostError(self._cluster.stranded)

    def _end(self, trial: Any, last: dict[str, Any]) -> None:
        self.ended += 1
        if _RAISED in last:
            raise pickle.loads(last[_RAISED])
        self._on_end(_name_of(trial), last[_RESULT], _WHOLE not in last)


def _name_of(trial: Any) -> str:
    return str(trial.config[_ITEM])


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Tune's messages about trials; the callbacks report them."""
    levels = {logger: logger.level for logger in map(logging.getLogger, _LOGGERS)}
    try:
        for logger in levels:
            logger.setLevel(logging.CRITICAL)
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


@contextmanager
def _interruptions_kept() -> Iterator[None]:
    """Restore the handler of Ctrl-C, which Tune replaces for good."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
