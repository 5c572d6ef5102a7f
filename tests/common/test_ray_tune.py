"""Work as trials of Ray Tune, on the cluster of two workers on this machine."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from test_parallel import alive, killed, wait_until

pytest.importorskip("ray.tune")

from greenhouse_gym import __version__
from greenhouse_gym.common.executors import RayExecutor, WorkerLostError
from greenhouse_gym.common.executors.ray_tune import FOLDER, Halving, OnProgress, _Trial, run_trials
from greenhouse_gym.errors import UnknownNameError

pytestmark = pytest.mark.xdist_group("ray")


def dying(folder: Path, on_progress: OnProgress) -> None:
    (folder / str(os.getpid())).touch()
    killed(0)


def racing(item: tuple[Path, float], on_progress: OnProgress) -> str:
    place, rate = item
    if not rate:
        raise UnknownNameError("rate", "zero", ["one"])
    try:
        for steps in range(1, 9):
            on_progress({"steps": steps, "rate": rate}, f"{place.name} at {steps}")
    except KeyboardInterrupt:
        place.touch()
        raise
    return f"{place.name} done"


def exiting(code: int, on_progress: OnProgress) -> None:
    sys.exit(code)


def resting(folder: Path, on_progress: OnProgress) -> None:
    try:
        while True:
            on_progress({"steps": float("nan")}, os.getpid())
            time.sleep(0.02)
    except KeyboardInterrupt:
        (folder / str(os.getpid())).touch()
        raise


def test_what_a_lost_process_was_at_is_begun_anew_as_often_as_said(cluster: RayExecutor, tmp_path: Path) -> None:
    ended: list[Any] = []
    run_trials(dying, {"one": tmp_path}, cluster, tmp_path, lambda *all_of: ended.append(all_of))
    ((name, lost, early),) = ended
    assert (name, early) == ("one", False)
    assert isinstance(lost, WorkerLostError)
    message = "its process or node died, or could not start or return the task, 2 times (details in tune/one/"
    assert str(lost).startswith(message)
    assert "worker process has died" in (tmp_path / FOLDER / name / "error.txt").read_text()
    assert len([path for path in tmp_path.iterdir() if path.name.isdecimal()]) == 2


def test_what_falls_behind_is_ended_where_it_stands_and_errors_end_all(cluster: RayExecutor, tmp_path: Path) -> None:
    told: list[str] = []
    ended: list[Any] = []
    one_by_one = RayExecutor(cpus=2)
    items = {name: (tmp_path / name, rate) for name, rate in (("fast", 1.0), ("slow", 0.5), ("bad", 0.0), ("last", 1))}
    with pytest.raises(UnknownNameError, match="unknown rate 'zero'") as caught:
        run_trials(
            racing, items, one_by_one, tmp_path, lambda *all_of: ended.append(all_of), told.append,
            Halving("rate", "steps", 8),
        )  # fmt: skip
    assert caught.value.choices == ("one",)
    assert told == [f"fast at {steps}" for steps in range(1, 9)]
    assert ended == [("fast", "fast done", False), ("slow", "slow at 1", True)]
    assert (tmp_path / "slow").exists(), "it had time to end itself"


def test_work_that_exits_is_told_and_not_waited_for() -> None:
    trial = _Trial.__new__(_Trial)  # without Ray, which would be asked for a process
    trial.setup({"item": "one"}, pickle.dumps((exiting, ({"one": 3},), {})), (str(Path.cwd()), [], __version__))
    told: list[Any] = []
    thread = threading.Thread(target=lambda: told.append(trial.step()), daemon=True)
    thread.start()
    thread.join(30.0)
    assert told, "it would be waited for without end"
    assert str(pickle.loads(told[0]["raised"])) == "a task ended by SystemExit: 3"


def test_an_interruption_lets_the_work_end_itself(cluster: RayExecutor, tmp_path: Path) -> None:
    pids: list[int] = []

    def interrupt(pid: int) -> None:
        if not pids:
            os.kill(os.getpid(), signal.SIGINT)
        pids.append(pid)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run_trials(resting, {"one": tmp_path}, cluster, tmp_path, lambda *_: None, interrupt)
    assert signal.getsignal(signal.SIGINT) is before
    assert (tmp_path / str(pids[0])).exists()
    wait_until(lambda: not alive(pids[0]))
