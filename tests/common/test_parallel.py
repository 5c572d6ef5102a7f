from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from threading import Event

import pytest
from parallel_helpers import Elsewhere

from greenhouse_gym.common.executors import WorkerLostError, completed, processes
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError


def squared(number: int) -> tuple[int, int]:
    return number, number * number


def spoiled(number: int) -> int:
    if number == 3:
        raise FileFormatError("scene.json", "is damaged")
    return number


def killed(number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return number


def asleep(folder: Path) -> None:
    (folder / str(os.getpid())).touch()
    time.sleep(600)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        status = Path(f"/proc/{pid}/status").read_text() if Path("/proc").exists() else ""
    except (ProcessLookupError, FileNotFoundError):  # it may end between the two
        return False
    return "\nState:\tZ" not in status


def wait_until(met: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.fixture(scope="module")
def pool() -> Iterator[Executor]:
    with processes(2) as executor:
        yield executor


def test_without_an_executor_each_result_is_made_when_it_is_asked_for() -> None:
    begun: list[int] = []
    results = completed(lambda k: (begun.append(k), k)[1], range(5))
    assert begun == []
    assert next(results) == 0
    assert begun == [0]
    assert list(results) == [1, 2, 3, 4]


def test_processes_give_what_one_process_gives(pool: Executor) -> None:
    assert sorted(completed(squared, range(20), pool)) == list(completed(squared, range(20)))
    assert list(completed(squared, [], pool)) == []


def test_results_come_as_they_are_finished() -> None:
    first_may_end = Event()

    def one(number: int) -> int:
        if number == 0:
            first_may_end.wait(60)
        return number

    with ThreadPoolExecutor(2) as threads:
        results = completed(one, range(3), threads)
        assert next(results) in (1, 2)
        first_may_end.set()
        assert 0 in list(results)


def test_items_are_taken_as_workers_get_free() -> None:
    taken: list[int] = []
    with ThreadPoolExecutor(2) as threads:
        results = completed(squared, (taken.append(k) or k for k in range(1000)), threads)
        for done, _ in enumerate(results, 1):
            assert len(taken) <= done + 2 * 2
    assert len(taken) == 1000


def test_what_has_not_begun_is_canceled_when_the_caller_stops() -> None:
    begun: list[int] = []
    go_on = Event()

    def one(number: int) -> int:
        begun.append(number)
        if number:
            go_on.wait(60)
        return number

    with ThreadPoolExecutor(1) as threads:
        results = completed(one, range(10), threads)
        assert next(results) == 0
        results.close()  # type: ignore[attr-defined]
        go_on.set()
    assert len(begun) <= 2


def test_an_error_in_a_worker_is_told_as_itself(pool: Executor) -> None:
    with pytest.raises(FileFormatError, match=r"^scene\.json: is damaged$") as caught:
        list(completed(spoiled, range(10), pool))
    assert caught.value.path == "scene.json"
    assert sorted(completed(squared, range(3), pool)) == [(0, 0), (1, 1), (2, 4)]


def test_a_lost_process_is_told_and_replaced() -> None:
    with processes(1) as executor:
        with pytest.raises(WorkerLostError, match="ended before its task was done"):
            list(completed(killed, range(3), executor))
        assert sorted(completed(squared, range(2), executor)) == [(0, 0), (1, 1)]


def test_what_is_finished_comes_before_an_error_of_the_same_moment() -> None:
    results = completed(spoiled, [3, 0, 1], Elsewhere())
    assert {next(results), next(results)} == {0, 1}
    with pytest.raises(FileFormatError):
        next(results)


def test_an_executor_that_was_shut_down_is_told() -> None:
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    with pytest.raises(InvalidValueError, match="an open executor"):
        list(completed(squared, range(3), executor))


@pytest.mark.parametrize("count", [0, -1, True, 1.5])
def test_impossible_numbers_of_processes_are_told(count: int) -> None:
    with pytest.raises(InvalidValueError, match="number of processes"), processes(count):
        pass


def test_an_interruption_ends_the_processes_at_once(tmp_path: Path) -> None:
    def interrupted(executor: Executor) -> None:
        executor.submit(asleep, tmp_path)
        wait_until(lambda: list(tmp_path.iterdir()))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), processes(1) as executor:
        interrupted(executor)
    (pid,) = (int(path.name) for path in tmp_path.iterdir())
    assert not alive(pid)


SCRIPT = """
import sys
from pathlib import Path
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/.."]
from test_parallel import asleep
from greenhouse_gym.common.executors import completed, processes
if __name__ == "__main__":
    with processes(1) as executor:
        list(completed(asleep, [Path(sys.argv[2])], executor))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT], ids=["killed", "Ctrl-C"])
def test_processes_end_with_their_caller(tmp_path: Path, number: signal.Signals) -> None:
    script, notes = tmp_path / "script.py", tmp_path / "notes"
    script.write_text(SCRIPT)
    notes.mkdir()
    arguments = [sys.executable, str(script), str(Path(__file__).parent), str(notes)]
    caller = subprocess.Popen(arguments, stderr=subprocess.PIPE)
    wait_until(lambda: list(notes.iterdir()))
    caller.send_signal(number)
    caller.communicate(timeout=60)
    (pid,) = (int(path.name) for path in notes.iterdir())
    wait_until(lambda: not alive(pid))


def test_an_unknown_name_keeps_its_choices_on_the_way(pool: Executor) -> None:
    with pytest.raises(UnknownNameError) as caught:
        list(completed(unknown, ["ur"], pool))
    assert caught.value.choices == ("ur5e",)


def unknown(name: str) -> None:
    raise UnknownNameError("arm", name, ["ur5e"])
