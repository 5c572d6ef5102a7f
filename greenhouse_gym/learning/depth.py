"""What the `DepthAgent` judges ways by, learned where it itself leads (DAgger: Ross, Gordon and Bagnell, 2011).

The teacher knows the scene and says of every way that the agent looked at whether it is free; the network learns to say
so from what the agent has seen. In the first round the agent goes by the rule `guessed`, then by what it has learned.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.depth_agent import DepthAgent, Ways
from greenhouse_gym.agents.judging import FEATURES, Judge, guessed
from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.common.files import parsing, read_bytes, write_atomically
from greenhouse_gym.envs import make_env
from greenhouse_gym.envs.settings import check_whole
from greenhouse_gym.errors import FileFormatError, MissingDependencyError, require_seed
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.learning.curves import CURVE, write_curve
from greenhouse_gym.learning.folders import check_folder
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.reach import arm_reaches
from greenhouse_gym.scene import SceneBank

try:
    import torch
    from safetensors.numpy import load, save
    from torch.utils.tensorboard import SummaryWriter
except ImportError as error:  # pragma: no cover - depends on the installation
    raise MissingDependencyError("torch", "train") from error

RESOLUTION = 0.03
"""How far any point of the arm may move between two checks of the teacher, metres."""

TOLD = 3
"""The teacher is asked about one way in so many: those that are looked at together are much alike."""

SETTINGS = "settings.json"
"""File of a training that tells its settings."""

Told = Callable[[int, dict[str, float]], None]

_JUDGED_SEED = 10_000


@dataclass(frozen=True)
class DepthSettings:
    """Settings of a training.

    Attributes:
        bank: Name or folder of the scene bank.
        split: Split to train on.
        robot: The arm.
        difficulty: Difficulties of the targets.
        images: Whether the agent takes in its images. Without them it goes by the kinematics alone, which tells what
            the images are worth.
        rounds: Rounds of playing and training.
        episodes: Episodes of each round.
        margin: Distance to obstacles that the teacher asks of a free way, metres.
        hidden: Sizes of the hidden layers.
        batch_size: Ways per gradient step.
        updates: Gradient steps after each round.
        learning_rate: Learning rate at the start of a round; it falls to zero.
        weight_decay: Share of the weights that a gradient step takes away, in learning rates: the ways of an episode
            are alike, and there are few episodes.
        validation_episodes: Episodes of validation rows that the agent plays after each round, always the same ones;
            none with 0.
        seed: Seed of episodes and weights.
    """

    bank: str = "default"
    split: str = "train"
    robot: str = "ur5e"
    difficulty: tuple[str, ...] = ("easy", "medium")
    images: bool = True
    rounds: int = 3
    episodes: int = 70
    margin: float = 0.003
    hidden: tuple[int, ...] = (32,)
    batch_size: int = 512
    updates: int = 600
    learning_rate: float = 3e-3
    weight_decay: float = 0.3
    validation_episodes: int = 0
    seed: int = 0


class Labels(NamedTuple):
    """Ways that the agent looked at, and what the teacher says of them.

    Attributes:
        features: (n, f) see `greenhouse_gym.agents.judging.FEATURES`.
        free: (n,) 1 for those that are free, 0 for the others.
    """

    features: npt.NDArray[np.float32]
    free: npt.NDArray[np.float32]


def train_depth(
    settings: DepthSettings, out: str | Path, *, resume: bool = False, tell: Told = lambda episodes, figures: None
) -> Path:
    """Train the network of a `DepthAgent`.

    ``out`` gets ``settings.json``, ``curve.csv`` (a line per round), ``tensorboard`` (the same), the labels of each
    round, and after each round ``judge.json`` with ``judge.safetensors`` beside it. A resumed training goes on with the
    round that is missing.

    Args:
        settings: The settings.
        out: Folder for the results.
        resume: Go on in ``out``; otherwise it must not hold a training.
        tell: Gets the episodes so far and figures after each round.

    Returns:
        The path of the network's JSON file.

    Raises:
        InvalidValueError: There is nothing to resume, or something that would be overwritten, or it was made with
            other settings.
        FileFormatError: The labels of a round are damaged.
    """
    require_seed(settings.seed)
    check_whole("validation_episodes", settings.validation_episodes, 0)
    out = Path(out)
    described = json.loads(json.dumps(asdict(settings)))
    check_folder(out / SETTINGS, lambda: _settings_in(out / SETTINGS), described, "rounds", resume)
    write_atomically(out / SETTINGS, json.dumps(described, indent=1) + "\n")
    torch.set_num_threads(1)
    rounds = [read_labels(path) for path in _kept(out)]
    rows = [row for _, row in rounds]
    labels = [label for label, _ in rounds]
    judge = _fitted(labels, settings, out, rows) if rounds else None
    for k in range(len(rounds), settings.rounds):
        began = time.process_time()
        collected, figures = play(settings, guessed if judge is None else judge, settings.seed + k * settings.episodes)
        labels.append(collected)
        rows.append({**figures, "collecting": time.process_time() - began})
        began = time.process_time()
        judge = _fitted(labels, settings, out, rows)
        rows[-1]["training"] = time.process_time() - began
        rows[-1] |= _judged(settings, judge)
        write_labels(out / f"round-{k}.safetensors", collected, rows[-1])
        write_curve(out / CURVE, list(rows[-1]), rows)
        with closing(SummaryWriter(str(out / "tensorboard"))) as curves:  # type: ignore[no-untyped-call]
            for name, value in rows[-1].items():
                curves.add_scalar(f"depth/{name}", value, (k + 1) * settings.episodes)  # type: ignore[no-untyped-call]
        tell((k + 1) * settings.episodes, rows[-1])
    return out / "judge.json"


def play(
    settings: DepthSettings, judge: Callable[[npt.NDArray[np.float32]], npt.NDArray[Any]], first_seed: int
) -> tuple[Labels, dict[str, float]]:
    """Play a round of episodes, and have the teacher judge the ways that the agent looks at.

    Args:
        settings: The settings.
        judge: What the agent goes by.
        first_seed: Seed of the first episode.

    Returns:
        The labels, and the shares of successes and collisions.
    """
    features: list[npt.NDArray[np.float32]] = []
    free: list[bool] = []
    checker: CollisionChecker | None = None

    def hear(ways: Ways) -> None:
        assert checker is not None
        features.append(ways.features[::TOLD])
        free.extend(checker.path_is_free([ways.start, *way], RESOLUTION) for way in ways.points[::TOLD])

    agent = DepthAgent(judge, hear, images=settings.images)
    env = make_env(
        bank=settings.bank, split=settings.split, robot=settings.robot, difficulty=settings.difficulty,
        **agent.env_options,
    )  # fmt: skip
    won = touched = 0
    with closing(env):
        simulation = env.simulation
        for seed in range(first_seed, first_seed + settings.episodes):
            seen, info = env.reset(seed=seed)
            episode = simulation.episode(0)
            compiled, target = simulation.physical(0)
            reaches = arm_reaches(simulation.robot)
            checker = CollisionChecker(planning_model(compiled, target, settings.margin), reaches)
            agent.reset(Problem(episode.scene, simulation.target(0), simulation.robot, episode.start, seed))
            ended = False
            while not ended:
                seen, _, terminated, truncated, info = env.step(agent.act(seen))
                ended = terminated or truncated
            won, touched = won + bool(info["is_success"]), touched + bool(info["collision"])
    found = Labels(np.concatenate(features), np.array(free, dtype=np.float32))
    figures = {"labels": float(len(free)), "free": float(found.free.mean())}
    return found, {"success": won / settings.episodes, "collision": touched / settings.episodes, **figures}


def _judged(settings: DepthSettings, judge: Judge) -> dict[str, float]:
    """How the agent does on rows that are not trained on, with what it has learned so far."""
    if not settings.validation_episodes:
        return {}
    found = evaluate(
        DepthAgent(judge, images=settings.images), "validation", settings.validation_episodes, seed=_JUDGED_SEED,
        progress=False, bank=settings.bank, robot=settings.robot, difficulty=settings.difficulty,
    )  # fmt: skip
    return {"validation_success": found.success_rate, "validation_collision": found.collision_rate}


def fit(labels: Labels, settings: DepthSettings) -> tuple[Policy, float]:
    """A network that says what the teacher says, and its mean squared error on these labels, of -1 or 1 each."""
    torch.manual_seed(settings.seed)
    random = np.random.default_rng(settings.seed)
    center, scale = labels.features.mean(axis=0), labels.features.std(axis=0) + np.float32(1e-3)
    x = torch.as_tensor((labels.features - center) / scale)
    y = torch.as_tensor(2 * labels.free - 1)
    sizes = [x.shape[1], *settings.hidden, 1]
    linear = [torch.nn.Linear(a, b) for a, b in pairwise(sizes)]
    layers: list[torch.nn.Module] = [linear[0]]
    for layer in linear[1:]:
        layers += [torch.nn.ReLU(), layer]
    network = torch.nn.Sequential(*layers)
    optimizer = torch.optim.AdamW(network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    for step in range(settings.updates):
        for group in optimizer.param_groups:
            group["lr"] = settings.learning_rate * (1 - step / settings.updates)
        batch = torch.as_tensor(random.integers(len(x), size=settings.batch_size))
        loss = ((network(x[batch])[:, 0] - y[batch]) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    with torch.no_grad():
        error = float(((network(x)[:, 0] - y) ** 2).mean())
    return Policy(
        weights=tuple(layer.weight.detach().numpy().copy() for layer in linear),
        biases=tuple(layer.bias.detach().numpy().copy() for layer in linear),
        activation="relu",
        center=center,
        scale=scale,
        env_options={"robot": settings.robot, "observation": "depth"},
        layout=FEATURES,
    ), error


def _fitted(labels: list[Labels], settings: DepthSettings, out: Path, rows: list[dict[str, float]]) -> Judge:
    """What all rounds so far teach, written into ``out``."""
    together = Labels(*(np.concatenate(parts) for parts in zip(*labels, strict=True)))
    network, rows[-1]["error"] = fit(together, settings)
    described = json.loads(json.dumps(asdict(settings)))
    notes = {"settings": described, "bank_sha256": SceneBank.open(settings.bank).sha256, "curve": rows}
    training = {"algorithm": "DAgger", **notes}
    replace(network, training=training).save(out / "judge")
    return Judge(network)


def _kept(out: Path) -> Iterator[Path]:
    """The files of the rounds that are done, in their order."""
    k = 0
    while (path := out / f"round-{k}.safetensors").is_file():
        yield path
        k += 1


def write_labels(path: Path, labels: Labels, row: dict[str, float]) -> None:
    """Write the labels of a round, and its line of the curve."""
    figures = {f"row.{name}": np.array([value]) for name, value in row.items()}
    features = np.ascontiguousarray(labels.features)  # what is laid out otherwise would be written in disorder
    write_atomically(path, save({"features": features, "free": labels.free, **figures}))


def read_labels(path: Path) -> tuple[Labels, dict[str, float]]:
    """The labels of a round, and its line of the curve.

    Raises:
        FileFormatError: The file is missing or damaged.
    """
    with parsing(path, "labels of a round"):
        arrays = load(read_bytes(path, "checkpoint"))
        labels = Labels(arrays["features"], arrays["free"])
    width = sum(size for _, size in FEATURES)
    if labels.features.shape != (len(labels.free), width) or not np.isfinite(labels.features).all():
        raise FileFormatError(path, f"features must be finite, of shape ({len(labels.free)}, {width})")
    return labels, {name[4:]: float(value[0]) for name, value in arrays.items() if name.startswith("row.")}


def _settings_in(path: Path) -> dict[str, Any]:
    with parsing(path, "settings"):
        return dict(json.loads(read_bytes(path, "settings")))
