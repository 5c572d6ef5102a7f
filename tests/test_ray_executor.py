"""Ray's executor, on a cluster of two workers on this machine."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

import pytest
from test_parallel import alive, asleep, killed, spoiled, squared, unknown, wait_until

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.parallel import RayExecutor, WorkerLostError, completed, workers_of
from greenhouse_gym.scene import SceneBank

pytestmark = pytest.mark.xdist_group("ray")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Executor]:
    pytest.importorskip("ray")
    with RayExecutor(workers=2, retries=0) as executor:
        yield executor


def folder_and_pid(number: int) -> tuple[str, int, int]:
    return str(Path.cwd()), os.getpid(), number


def test_ray_gives_what_one_process_gives(cluster: Executor) -> None:
    assert workers_of(cluster) == 2
    assert sorted(completed(squared, range(20), cluster)) == list(completed(squared, range(20)))


def test_work_is_done_elsewhere_in_the_callers_folder(cluster: Executor) -> None:
    for folder, pid, _ in completed(folder_and_pid, range(4), cluster):
        assert folder == str(Path.cwd())
        assert pid != os.getpid()


def test_errors_are_told_as_themselves(cluster: Executor) -> None:
    with pytest.raises(FileFormatError, match=r"^scene\.json: is damaged$") as caught:
        list(completed(spoiled, range(10), cluster))
    assert caught.value.path == "scene.json"
    assert caught.value.__cause__ is None
    with pytest.raises(UnknownNameError) as unknown_arm:
        list(completed(unknown, ["ur"], cluster))
    assert unknown_arm.value.choices == ("ur5e",)


def test_a_lost_process_is_told_and_the_cluster_goes_on(cluster: Executor) -> None:
    with pytest.raises(WorkerLostError, match="a piece of work was lost"):
        list(completed(killed, range(1), cluster))
    assert sorted(completed(squared, range(3), cluster)) == [(0, 0), (1, 1), (2, 4)]


def test_a_canceled_piece_of_work_really_ends(cluster: Executor, tmp_path: Path) -> None:
    future = cluster.submit(asleep, tmp_path)
    wait_until(lambda: list(tmp_path.iterdir()))
    assert future.cancel()
    (pid,) = (int(path.name) for path in tmp_path.iterdir())
    wait_until(lambda: not alive(pid))


def test_agents_play_the_same_episodes_on_ray(cluster: Executor, bank: SceneBank) -> None:
    here, there = (evaluate(RandomAgent(), episodes=3, bank=bank, executor=e) for e in (None, cluster))
    untimed = {"planning_time": 0.0, "action_time": 0.0}
    assert [replace(r, **untimed) for r in there.records] == [replace(r, **untimed) for r in here.records]


def test_addresses_at_which_nothing_listens_are_told() -> None:
    pytest.importorskip("ray")
    with pytest.raises(InvalidValueError, match=r"nothing listens at 127\.0\.0\.1:1"):
        RayExecutor("127.0.0.1:1")
    with pytest.raises(InvalidValueError, match="HOST:PORT"):
        RayExecutor("somewhere")
