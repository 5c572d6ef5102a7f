"""Episodes of an agent as a Minari data set, for offline learning."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.agents.agent import Agent, Problem, knows_truth, options_for
from greenhouse_gym.agents.named import agent_of
from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import exclusive, parsing
from greenhouse_gym.envs import GreenhouseEnv, make_env
from greenhouse_gym.errors import FileWriteError, InvalidValueError, check_whole, require_seed
from greenhouse_gym.scene import SceneBank

DATA_SET = "tomato-reach/{agent}-v0"
"""Name of a data set in its folder."""

SAVE_SECONDS = 60.0
"""Time between two additions to the data set, seconds."""


def record_demonstrations(
    agent: Agent | str,
    out: str | Path,
    episodes: int = 100,
    seed: int = 0,
    split: str = "train",
    successes_only: bool = True,
    on_progress: Callable[[int], None] = lambda done: None,
    **options: Any,
) -> str:
    """Record episodes of an agent, with rewards and infos, as a Minari data set.

    The episodes are written every minute, and at the end, also after an interruption. If one writing fails, for example
    on a full disk, the data set keeps the episodes that it holds. The same call resumes after the last of them.

    Args:
        agent: The agent, or a name that `make_agent` takes; its ``env_options`` choose the environment.
        out: Folder of data sets (``MINARI_DATASETS_PATH``).
        episodes: Number of episodes to run; episode i has the seed ``seed + i``.
        seed: Seed of the first episode.
        split: Split of the bank; the test split is refused.
        successes_only: Whether only successful episodes are kept.
        on_progress: Called with the number of episodes so far.
        **options: Further keywords of the environment.

    Returns:
        The data set's name, as ``minari.load_dataset`` takes it; its ``recover_environment`` makes the environment.

    Raises:
        InvalidValueError: The split is "test", no episode succeeded, or the folder holds the agent's data set of other
            settings.
        FileWriteError: The folder cannot be written, or another process records the data set.
        MissingDependencyError: Minari is not installed.
    """
    with needs("data"):
        from minari.data_collector import EpisodeBuffer
    agent, seed, episodes = agent_of(agent), require_seed(seed), check_whole("episodes", episodes, 1)
    if split == "test":
        raise InvalidValueError("split 'test' is reserved for the final evaluation: choose train or validation")
    name = DATA_SET.format(agent="".join(c if c.isalnum() else "-" for c in agent.name.lower()))
    env = make_env(split=split, **options_for(agent, options))
    bank = SceneBank.open(env.settings.bank)
    about = {
        "env_spec": env.settings.spec(),
        "algorithm_name": agent.name,
        "description": f"TomatoReach-v0, split {env.settings.split} of bank {bank.manifest.name}, manifest sha256 "
        f"{bank.sha256}, {'successful' if successes_only else 'all'} episodes from seed {seed} on",
    }
    folder, buffers, saved = Path(out) / name, list[Any](), time.monotonic()
    try:
        with exclusive(folder):
            kept, done = _resumed(Path(out), name, about, seed)
            try:
                for i in range(done, episodes):
                    buffer = EpisodeBuffer(id=kept + len(buffers), seed=seed + i, **_run(agent, env, seed + i))
                    if buffer.infos["is_success"][-1] or not successes_only:  # type: ignore[index]
                        buffers.append(buffer)
                    on_progress(i + 1)
                    if buffers and time.monotonic() - saved > SAVE_SECONDS:
                        kept, buffers, saved = _add(Path(out), name, buffers, kept, env, about), [], time.monotonic()
            finally:
                if buffers:
                    kept = _add(Path(out), name, buffers, kept, env, about)
    finally:
        env.close()
    if not kept:
        folder.rmdir()
        raise InvalidValueError(
            f"agent {agent.name!r} reached no target in {episodes} episodes: there is nothing to record"
        )
    return name


def _resumed(out: Path, name: str, about: Mapping[str, Any], seed: int) -> tuple[int, int]:
    """Return the number of episodes in a data set, and of those that were run for them.

    Raises:
        InvalidValueError: The data set is about something else.
    """
    import minari

    if not (out / name / "data" / "metadata.json").is_file():
        return 0, 0
    with _datasets_in(str(out)), parsing(out / name, "Minari data set"):
        data = minari.load_dataset(name)
        there = data.storage.metadata
        last = next(iter(data.storage.get_episode_metadata([data.total_episodes - 1])))
        done = int(last["seed"]) + 1 - seed
    if any(there[key] != (value.to_json() if key == "env_spec" else value) for key, value in about.items()):
        raise InvalidValueError(f"{out} already holds a data set {name} of other settings: choose another folder")
    return data.total_episodes, done


def _add(out: Path, name: str, buffers: list[Any], kept: int, env: GreenhouseEnv, about: Mapping[str, Any]) -> int:
    """Add episodes to a data set of ``kept`` episodes and return their new number.

    They are added to a copy, which then replaces the data set.
    """
    import h5py
    import minari

    copied = {"suffix": ".part", "prefix": ".", "dir": out / name, "ignore_cleanup_errors": True}
    try:
        with tempfile.TemporaryDirectory(**copied) as copy, _datasets_in(copy):  # type: ignore[call-overload]
            if kept:
                shutil.copytree(out / name / "data", Path(copy) / name / "data")
                with h5py.File(Path(copy) / name / "data" / "main_data.hdf5", "a") as file:
                    for extra in range(kept, len(file)):  # of a process that was killed before it wrote their number
                        del file[f"episode_{extra}"]
                minari.load_dataset(name).update_dataset_from_buffer(buffers)
            else:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", UserWarning)  # about a missing author, permalink and evaluation
                    minari.create_dataset_from_buffers(
                        name,
                        buffers,
                        env=about["env_spec"],
                        observation_space=env.observation_space,
                        action_space=env.action_space,
                        algorithm_name=about["algorithm_name"],
                        description=about["description"],
                        requirements=["greenhouse-gym"],
                        code_permalink=None, author=None, author_email=None,
                    )  # fmt: skip
            for path in sorted(Path(copy).rglob("*")):  # the episodes before their number
                if path.is_file():
                    target = out / path.relative_to(copy)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    path.replace(target)
    except (OSError, RuntimeError) as error:  # HDF5 raises either on a full disk
        named = re.search(r"error message = '([^']+)'", str(error))  # by HDF5, among much else
        problem = getattr(error, "strerror", None) or (named[1] if named else str(error).splitlines()[0])
        raise FileWriteError(out / name, OSError(f"{problem}; it keeps its first {kept} episodes")) from error
    return kept + len(buffers)


@contextmanager
def _datasets_in(folder: str) -> Iterator[None]:
    """Set the environment variable by which Minari finds its folder."""
    previous = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = folder
    try:
        yield
    finally:
        if previous is None:
            del os.environ["MINARI_DATASETS_PATH"]
        else:
            os.environ["MINARI_DATASETS_PATH"] = previous


def _run(agent: Agent, env: GreenhouseEnv, seed: int) -> dict[str, Any]:
    """Run an episode and return its columns."""
    observation, info = env.reset(seed=seed)
    agent.reset(Problem.of(env.simulation, 0, seed, knows_truth(agent)))
    columns: dict[str, list[Any]] = {
        "observations": [observation], "actions": [], "rewards": [], "terminations": [], "truncations": [],
    }  # fmt: skip
    infos = [_selected(info)]
    over = False
    while not over:
        action = np.asarray(agent.act(observation), dtype=np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        columns["observations"].append(observation)
        columns["actions"].append(action)
        columns["rewards"].append(float(reward))
        columns["terminations"].append(terminated)
        columns["truncations"].append(truncated)
        infos.append(_selected(info))
    return {**columns, "observations": _by_key(columns["observations"]), "infos": _by_key(infos)}


def _by_key(rows: list[Any]) -> Any:
    """Turn a list of dictionaries into the dictionary of lists that Minari expects; return anything else unchanged."""
    return {key: [row[key] for row in rows] for key in rows[0]} if isinstance(rows[0], Mapping) else rows


def _selected(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of an info that have the same type at every step."""
    return {
        "is_success": bool(info["is_success"]), "collision": bool(info["collision"]),
        "distance": float(info["distance"]), "clearance": float(info["clearance"]), "target": int(info["target"]),
        "scene": str(info["scene"]),
    }  # fmt: skip
