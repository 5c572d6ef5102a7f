"""Ray's executor, on a cluster of two workers on this machine."""

from __future__ import annotations

import os
import socket
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_parallel import alive, asleep, killed, spoiled, squared, unknown, wait_until

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.common.executors import RayActor, RayExecutor, WorkerLostError, completed, ray_executor, workers_of
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.scene import Scene, SceneBank

pytestmark = pytest.mark.xdist_group("ray")


class Counter:
    def __init__(self, start: int):
        if start < 0:
            raise FileFormatError("scene.json", "is damaged")
        self.count = start

    def add(self, number: int) -> tuple[int, int]:
        self.count += number
        return self.count, os.getpid()

    def die(self) -> None:
        killed(0)


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


def test_a_canceled_piece_of_work_really_ends(cluster: RayExecutor, tmp_path: Path) -> None:
    future = cluster.submit(asleep, tmp_path)
    wait_until(lambda: list(tmp_path.iterdir()))
    assert future.cancel()
    (pid,) = (int(path.name) for path in tmp_path.iterdir())
    wait_until(lambda: not alive(pid))


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


def test_an_actor_keeps_what_it_is_told(cluster: RayExecutor) -> None:
    actor = RayActor(cluster, Counter, 1)
    first, second = actor.ask("add", 2), actor.ask("add", 3)
    (three, pid), (six, same) = first(), second()
    assert (three, six, pid == same, pid == os.getpid()) == (3, 6, True, False)
    actor.end()
    wait_until(lambda: not alive(pid))


def test_what_fails_in_an_actor_is_told_as_itself(cluster: RayExecutor) -> None:
    actor = RayActor(cluster, Counter, -1)
    with pytest.raises(FileFormatError, match=r"^scene\.json: is damaged \(on node"):
        actor.ask("add", 1)()
    actor.end()
    actor = RayActor(cluster, Counter, 0)
    with pytest.raises(WorkerLostError, match="a process of the cluster was lost"):
        actor.ask("die")()


def test_actors_step_the_simulations_that_one_process_steps(cluster: RayExecutor, bank: SceneBank) -> None:
    """Over the ends of episodes, bit for bit."""
    pytest.importorskip("stable_baselines3")
    from greenhouse_gym.learning.sb3 import make_sb3_vec_env
    from greenhouse_gym.learning.sb3_ray import make_sb3_ray_vec_env

    here = make_sb3_vec_env(5, bank=bank, seed=3, threads=1, observation="goal", reward="sparse")
    there = make_sb3_ray_vec_env(5, bank=bank, seed=3, actors=2, observation="goal", reward="sparse")
    assert_equal(here.reset(), there.reset())
    actions, ended = np.zeros((5, 6), dtype=np.float32), 0
    actions[:, 1] = 0.2, 0.4, 0.6, 0.8, 1.0  # into the plants, one after the other
    for _ in range(40):
        of_here, of_there = here.step(actions), there.step(actions)
        assert_equal(dict(enumerate(of_here[:3])), dict(enumerate(of_there[:3])))
        for one, other in zip(of_here[3], of_there[3], strict=True):
            one.pop("episode", None), other.pop("episode", None)  # which tell of time
            assert_equal(one, other)
        ended += int(of_here[2].sum())
    assert ended > 0
    there.close()


def assert_equal(one: Any, other: Any) -> None:
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal(one[key], other[key])
    else:
        np.testing.assert_array_equal(one, other)


def test_more_actors_than_cores_are_told(cluster: RayExecutor, bank: SceneBank) -> None:
    pytest.importorskip("stable_baselines3")
    from greenhouse_gym.learning.sb3_ray import make_sb3_ray_vec_env

    with pytest.raises(InvalidValueError, match="the cluster has cores for 2 actors, got 3"):
        make_sb3_ray_vec_env(5, bank=bank, actors=3)
    with pytest.raises(InvalidValueError, match="num_envs must be a whole number from 2 up, got 1"):
        make_sb3_ray_vec_env(1, bank=bank, actors=2)


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
    with pytest.raises(InvalidValueError, match=r"the head 9\.9: install the same on all"):
        RayActor(cluster, Counter, 1).ask("add", 1)()


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
    with pytest.raises(InvalidValueError, match="an executor that is at work"):
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
