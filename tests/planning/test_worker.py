from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from greenhouse_gym.errors import MissingDependencyError
from greenhouse_gym.planning import PLANNERS, goal_configurations, plan, planner_run
from greenhouse_gym.planning.worker import (
    Worker,
    WorkerCrashedError,
    WorkerFailedError,
    WorkerTimeoutError,
    shared_worker,
)
from greenhouse_gym.scene import Scene

OF_OMPL = sum(info.solve is None for info in PLANNERS.values())


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    """One worker for all tests, since a process takes seconds to start; each test leaves it ready for calls."""
    worker = Worker()
    yield worker
    worker.close()


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Ctrl-C is heard even where the tests run in the background of a shell, which has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_hang_ends_at_the_hard_limit_and_the_next_call_works(worker: Worker) -> None:
    assert len(worker.call("planners", None, 30.0)) == OF_OMPL
    first = worker.pid
    began = time.perf_counter()
    with pytest.raises(WorkerTimeoutError, match=r"0\.3 s"):
        worker.call("sleep", 60.0, 0.3)
    assert time.perf_counter() - began < 5.0
    assert first is not None
    assert not alive(first)
    assert len(worker.call("planners", None, 30.0)) == OF_OMPL
    assert worker.pid != first


def test_an_idle_process_that_is_killed_is_replaced(worker: Worker) -> None:
    worker.call("planners", None, 30.0)
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    assert len(worker.call("planners", None, 30.0)) == OF_OMPL


def test_what_fails_in_one_process_is_tried_in_another_next_time(worker: Worker) -> None:
    """A process that had run out of memory failed every query after that."""
    worker.call("sleep", 0.0, 60.0)
    first = worker.pid
    with pytest.raises(WorkerFailedError, match="KeyError: 'dance'"):
        worker.call("dance", None, 5.0)
    assert worker.call("sleep", 0.0, 60.0) is None
    assert worker.pid not in (None, first)


def test_killed_from_outside_while_planning(scene: Scene) -> None:
    plan(scene, 0, planner="SBL")  # kernels are compiled from here on
    shared_worker().call("sleep", 0.0, 30.0)
    pid = shared_worker().pid
    assert pid is not None
    killer = threading.Timer(0.5, os.kill, (pid, signal.SIGKILL))
    killer.start()
    result = plan(scene, 0, planner="RRTstar", time_limit=20.0)
    killer.join()
    assert result.status == "crashed"
    assert result.path is None
    assert "signal 9" in result.message
    assert plan(scene, 0, planner="SBL").status == "solved"


def test_a_planner_that_ignores_its_limit_times_out(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    shared_worker().call("sleep", 0.0, 30.0)
    with monkeypatch.context() as patched:
        patched.setattr(planner_run, "GRACE", -19.5)  # an optimizing planner uses all of its 20 s
        result = plan(scene, 0, planner="RRTstar", time_limit=20.0)
    assert result.status == "timeout"
    assert result.path is None
    assert 0.4 < result.planning_time < 5.0
    assert plan(scene, 0, planner="SBL").status == "solved"


def test_an_error_in_ompl_is_a_status(scene: Scene) -> None:
    refused = {"border_fraction": 0.0}  # within OMPL's own range
    result = plan(scene, 0, planner="KPIECE1", time_limit=2.0, settings=refused)
    assert result.status == "crashed"
    assert "KPIECE1: RuntimeError: The fraction of time" in result.message


def test_too_much_memory_is_refused_and_the_next_call_works() -> None:
    worker = Worker(memory_limit=1 << 30)
    try:
        assert worker.call("fill", 100 << 20, 30.0) == 100 << 20
        with pytest.raises(WorkerFailedError, match="MemoryError"):
            worker.call("fill", 2 << 30, 30.0)
        assert worker.call("sleep", 0.0, 30.0) is None
    finally:
        worker.close()


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_while_planning(scene: Scene) -> None:
    assert plan(scene, 0, planner="SBL").status == "solved"
    threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        plan(scene, 0, planner="RRTstar", time_limit=30.0)
    assert plan(scene, 0, planner="SBL").status == "solved"


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_reaches_the_caller_and_the_next_call_works(worker: Worker) -> None:
    worker.call("sleep", 0.0, 30.0)
    first = worker.pid
    assert first is not None
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        worker.call("sleep", 60.0, 30.0)
    assert not alive(first)
    assert len(worker.call("planners", None, 30.0)) == OF_OMPL


def test_without_ompl_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("greenhouse_gym.planning.worker.find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"greenhouse-gym\[plan\]"):
        Worker().call("planners", None, 30.0)


def test_a_dead_process_has_an_error_of_its_own(worker: Worker) -> None:
    worker.call("sleep", 0.0, 30.0)
    assert worker.pid is not None
    threading.Timer(0.3, os.kill, (worker.pid, signal.SIGSEGV)).start()
    with pytest.raises(WorkerCrashedError, match="signal 11"):
        worker.call("sleep", 60.0, 30.0)


SCRIPT = """
import sys
from greenhouse_gym.planning import plan
from greenhouse_gym.planning.worker import shared_worker
from greenhouse_gym.scene import Scene
result = plan(Scene.load(sys.argv[1]), 0, planner="SBL")
assert not any(name.split(".")[0] == "ompl" for name in sys.modules)
print(result.status, shared_worker().pid)
"""


@pytest.mark.parametrize("how", ["-c", *(pytest.param(how, marks=pytest.mark.slow) for how in ("script", "stdin"))])
def test_an_interpreter_exits_cleanly_after_planning(scene: Scene, tmp_path: Path, how: str) -> None:
    file = scene.save(tmp_path / "scene.json")
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    arguments = {"-c": ["-c", SCRIPT], "script": [str(script)], "stdin": ["-"]}[how]
    run = subprocess.run(
        [sys.executable, *arguments, str(file)],
        input=SCRIPT if how == "stdin" else None, capture_output=True, text=True, timeout=120, cwd=tmp_path,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert run.stderr == ""
    status, pid = run.stdout.split()
    assert status == "solved"
    assert not alive(int(pid))


def test_ompl_stays_out_of_the_process_that_plans(scene: Scene, tmp_path: Path) -> None:
    code = (
        "import sys; from greenhouse_gym.planning import plan; from greenhouse_gym.scene import Scene\n"
        "print([m for m in sys.modules if 'ompl_' in m])\n"
        f"print(plan(Scene.load({str(scene.save(tmp_path / 'scene.json'))!r}), 1, planner='SBL').status)\n"
        "print([m for m in sys.modules if m.split('.')[0] == 'ompl'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.split("\n") == ["[]", "solved", "[]", ""], done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends a process with its caller")
def test_the_process_dies_with_a_killed_caller() -> None:
    code = (
        "import threading\n"
        "from greenhouse_gym.planning.worker import shared_worker as w\n"
        "def work():\n"
        "    w().call('planners', None, 60.0)\n"
        "thread = threading.Thread(target=work); thread.start(); thread.join()\n"  # the process outlives this thread
        "w().call('planners', None, 60.0); print(w().pid, flush=True); w().call('sleep', 60.0, 60.0)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as caller:
        assert caller.stdout is not None
        pid = int(caller.stdout.readline())
        assert alive(pid)
        caller.kill()
    for _ in range(100):
        if not alive(pid):
            return
        time.sleep(0.05)
    pytest.fail("the planning process outlives its caller")


def test_the_process_outlives_the_thread_that_first_planned() -> None:
    worker = Worker()
    thread = threading.Thread(target=worker.call, args=("planners", None, 60.0))
    thread.start()
    thread.join()
    first = worker.pid
    worker.call("planners", None, 60.0)
    assert worker.pid == first
    worker.close()


def test_planning_is_imported_where_no_limits_of_memory_exist() -> None:
    code = (
        "import sys, os; sys.modules['resource'] = None; os.__dict__.pop('sched_getaffinity', None)\n"
        "import greenhouse_gym.planning, greenhouse_gym.planning.ompl_worker\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the memory of a process from /proc")
def test_queries_leave_no_memory_behind(scene: Scene) -> None:
    """Callbacks live on until the garbage is collected, and a model must not wait for that."""
    goals = goal_configurations(scene, 0, count=3)

    def megabytes_after(queries: int, kind: str) -> list[float]:
        found = []
        for seed in range(queries):
            assert plan(scene, 0, planner="SBL", goals=goals, seed=seed).status == "solved"
            status = Path(f"/proc/{shared_worker().pid}/status").read_text()
            found.append(int(status.split(f"{kind}:")[1].split()[0]) / 1024)
        return found

    reserved = megabytes_after(40, "VmData")[2:]  # what the limit counts: 40 MB of each model, most of it untouched
    assert max(reserved) - min(reserved) < 30
    touched = megabytes_after(80, "VmRSS")
    assert touched[-1] - touched[0] < 30
