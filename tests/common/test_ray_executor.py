"""Ray's executor, on a cluster of two workers on this machine."""

from __future__ import annotations

import os
import socket
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from test_parallel import alive, asleep, killed, spoiled, squared, unknown, wait_until

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.common.executors import RayExecutor, WorkerLostError, completed, ray_executor, workers_of
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.scene import Scene, SceneBank

pytestmark = pytest.mark.xdist_group("ray")


def folder_and_pid(number: int) -> tuple[str, int, int]:
    return str(Path.cwd()), os.getpid(), number


def test_ray_gives_what_one_process_gives(cluster: RayExecutor) -> None:
    assert workers_of(cluster) == 2
    assert sorted(completed(squared, range(20), cluster)) == list(completed(squared, range(20)))


def test_work_is_done_elsewhere_in_the_callers_folder(cluster: RayExecutor) -> None:
    for folder, pid, _ in completed(folder_and_pid, range(4), cluster):
        assert folder == str(Path.cwd())
        assert pid != os.getpid()


def test_errors_are_told_as_themselves(cluster: RayExecutor) -> None:
    with pytest.raises(FileFormatError, match=r"^scene\.json: is damaged \(on node") as caught:
        list(completed(spoiled, range(10), cluster))
    assert caught.value.path == "scene.json"
    assert caught.value.__cause__ is None
    with pytest.raises(UnknownNameError) as unknown_arm:
        list(completed(unknown, ["ur"], cluster))
    assert unknown_arm.value.choices == ("ur5e",)


def test_a_lost_process_is_told_and_the_cluster_goes_on(cluster: RayExecutor) -> None:
    with pytest.raises(WorkerLostError, match="a task was lost"):
        list(completed(killed, range(1), cluster))
    assert sorted(completed(squared, range(3), cluster)) == [(0, 0), (1, 1), (2, 4)]


def test_work_is_given_up_once_no_node_that_is_left_can_do_it(
    cluster: RayExecutor, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(ray_executor, "_LOOK", 0.05)
    lost: list[bool] = []
    monkeypatch.setattr(cluster.ray, "nodes", lambda: [{"Alive": not lost, "Resources": {"CPU": 2.0}}])
    with RayExecutor() as executor:
        work = executor.submit(asleep, tmp_path)
        wait_until(lambda: list(tmp_path.iterdir()))
        assert not executor.stranded
        lost.append(True)
        with pytest.raises(WorkerLostError, match=r"nodes of the cluster were lost: .* up to 0 cores, got cpus=1"):
            work.result(60)
    (pid,) = (int(path.name) for path in tmp_path.iterdir())
    wait_until(lambda: not alive(pid))


def test_a_canceled_piece_of_work_really_ends(cluster: RayExecutor, tmp_path: Path) -> None:
    future = cluster.submit(asleep, tmp_path)
    wait_until(lambda: list(tmp_path.iterdir()))
    assert future.cancel()
    (pid,) = (int(path.name) for path in tmp_path.iterdir())
    wait_until(lambda: not alive(pid))


def test_work_that_ends_while_it_is_canceled_does_no_harm(cluster: RayExecutor) -> None:
    for _ in range(200):  # Ray aborts the caller within about a hundred if it stops them at once
        with pytest.raises(FileFormatError):
            list(completed(spoiled, range(10), cluster))


def test_agents_play_the_same_episodes_on_ray(cluster: RayExecutor, bank: SceneBank) -> None:
    here, there = (evaluate(RandomAgent(), episodes=3, bank=bank, executor=e) for e in (None, cluster))
    untimed = {"planning_time": 0.0, "action_time": 0.0}
    assert [replace(r, **untimed) for r in there.records] == [replace(r, **untimed) for r in here.records]


def test_addresses_at_which_nothing_listens_are_told() -> None:
    pytest.importorskip("ray")
    with pytest.raises(InvalidValueError, match=r"no Ray cluster listens at 127\.0\.0\.1:1 "):
        RayExecutor("127.0.0.1:1")
    with pytest.raises(InvalidValueError, match="HOST:PORT"):
        RayExecutor("somewhere")


def test_an_address_at_which_something_else_listens_is_told() -> None:
    """Ray itself tries for minutes; Redis, say, has the port that its head used to have."""
    pytest.importorskip("ray")
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"

        def refuse() -> None:
            connection, _ = server.accept()
            with connection:
                connection.recv(1000)
                connection.sendall(b"-ERR unknown command\r\n")

        with ThreadPoolExecutor(1) as threads:
            threads.submit(refuse)
            with pytest.raises(InvalidValueError, match=f"the server at {address} is not the head of a Ray cluster"):
                RayExecutor(address)


def test_the_head_of_a_cluster_is_known_by_its_greeting(cluster: RayExecutor) -> None:
    address = cluster.ray.get_runtime_context().gcs_address
    with pytest.raises(InvalidValueError, match="this process is in a Ray cluster already"):
        RayExecutor(address)


def test_work_that_no_node_can_do_is_told_at_once(cluster: RayExecutor) -> None:
    with pytest.raises(InvalidValueError, match="have up to 2 cores, got cpus=64"):
        RayExecutor(cpus=64)
    with pytest.raises(InvalidValueError, match=r"have up to [\d.]+ GB, got memory=1000000000000000"):
        RayExecutor(memory=10**15)
    assert list(completed(squared, [3], cluster)) == [(3, 9)], "which leaves the cluster alone"


def test_a_node_with_another_version_is_told(cluster: RayExecutor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_executor, "__version__", "9.9")
    with pytest.raises(InvalidValueError, match=r"has greenhouse-gym \d\S+, the head 9\.9: install the same on all"):
        list(completed(squared, [1], cluster))


def test_a_path_that_a_node_does_not_see_is_told(cluster: RayExecutor, tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text("{}")
    with pytest.raises(FileFormatError, match=r"gone\.json: .*on node .*, which sees no such path"):
        list(completed(Scene.load, [tmp_path / "gone.json"], cluster))
    with pytest.raises(FileFormatError) as damaged:
        list(completed(Scene.load, [tmp_path / "scene.json"], cluster))
    assert "on node" not in str(damaged.value)


def test_a_cluster_that_was_left_is_told(cluster: RayExecutor) -> None:
    other = RayExecutor()
    other.shutdown()
    with pytest.raises(InvalidValueError, match="an open executor"):
        list(completed(squared, range(3), other))
    assert list(completed(squared, [3], cluster)) == [(3, 9)]


def test_an_interruption_ends_what_is_at_work_on_the_cluster(cluster: RayExecutor, tmp_path: Path) -> None:
    def interrupted(executor: RayExecutor) -> None:
        executor.submit(asleep, tmp_path)
        wait_until(lambda: list(tmp_path.iterdir()))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), RayExecutor() as other:
        interrupted(other)
    (pid,) = (int(path.name) for path in tmp_path.iterdir())
    wait_until(lambda: not alive(pid))
    assert list(completed(squared, [3], cluster)) == [(3, 9)], "the cluster is not this executor's to end"
