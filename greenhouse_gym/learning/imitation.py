"""Imitation of a rule in states that the learner itself reaches (DAgger: Ross, Gordon and Bagnell, 2011).

Training scenes are varied: mirrored, shifted, with moved plants and some fruit and clutter removed. A
variation is a plausible row, no more: its tomatoes keep their ratings, although it is not known whether they can still
be reached.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import action_towards
from greenhouse_gym.common.files import exclusive
from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.envs import GreenhouseVectorEnv, make_vec_env
from greenhouse_gym.envs.observations import Observed
from greenhouse_gym.envs.simulation import Simulation
from greenhouse_gym.errors import InvalidValueError, MissingDependencyError, require_seed
from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.shapes import mirrored
from greenhouse_gym.learning.picking_teacher import picking_labels
from greenhouse_gym.learning.ppo import train_ppo
from greenhouse_gym.learning.settings import BcThenPpoSettings, ImitationSettings
from greenhouse_gym.learning.training_run import as_json, check_start
from greenhouse_gym.learning.training_settings import physics_of
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.plant_motion import move_plants

LIVELY = PlantMotion(truss_turn=0.4, truss_swing=0.15, stem_shift=0.02, leaf_shift=0.03)
"""Motion of plants, several times that of real ones."""


@dataclass(frozen=True)
class Variation:
    """Limits of the difference between a variation and its scene.

    Attributes:
        plants: Motion of the plants.
        shift: Largest shift of everything along x, y and z, metres.
        thinning: Largest fraction of tomatoes, and of clutter, that is removed.
        mirrored: True to mirror half of the variations along the row.
    """

    plants: PlantMotion = LIVELY
    shift: tuple[float, float, float] = (0.03, 0.2, 0.06)
    thinning: float = 0.25
    mirrored: bool = True


def varied_scene(scene: Scene, rng: np.random.Generator, name: str, variation: Variation | None = None) -> Scene:
    """Sample a variation of a scene; its targets are the remaining ones, without witnesses."""
    variation = variation or Variation()
    plants = move_plants(scene, variation.plants, rng)
    flip = np.array([1.0, -1.0 if variation.mirrored and rng.random() < 0.5 else 1.0, 1.0])
    shift = rng.uniform(-1.0, 1.0, 3) * variation.shift
    tomatoes = _subset(len(plants.tomatoes), variation.thinning, rng)
    clutter = _subset(len(plants.clutter), variation.thinning, rng)
    index = {int(old): new for new, old in enumerate(tomatoes)}
    targets = (
        Target(tomato=index[t.tomato], difficulty=t.difficulty, robot=t.robot)
        for t in scene.targets
        if t.tomato in index and t.difficulty != "unreachable"
    )
    parts = {
        "tomatoes": tuple(
            replace(tomato, shape=mirrored(tomato.shape, flip, shift))
            for tomato in (plants.tomatoes[k] for k in tomatoes)
        ),
        "stems": tuple(mirrored(stem, flip, shift) for stem in plants.stems),
        "clutter": tuple(mirrored(plants.clutter[k], flip, shift) for k in clutter),
        "targets": tuple(targets),
    }
    return scene.model_copy(update={**parts, "name": name, "truth": None, "occupancy": None})


def varied_bank(
    bank: SceneBank, folder: str | Path, count: int, seed: int = 0, variation: Variation | None = None
) -> SceneBank:
    """Write a bank with a bank's scenes and ``count`` variations of its training scenes, equally many of each.

    The other splits are unchanged, so policies trained on the bank can be validated on it.
    """

    def scenes() -> Iterator[tuple[Scene, str]]:
        train = bank.names("train")
        for name in bank.names():
            yield bank.scene(name), bank.split_of(name)
        for k in range(count):
            source = bank.scene(train[k % len(train)])
            rng = np.random.default_rng([seed, k])
            yield varied_scene(source, rng, f"{source.name}-varied-{k}", variation), "train"

    return write_bank(folder, scenes(), "varied", "Scenes and variations of them, to train on.")


def _subset(count: int, thinning: float, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    return np.flatnonzero(rng.random(count) >= rng.uniform(0.0, thinning))


try:
    import torch
except ImportError as error:  # pragma: no cover - depends on the installation
    raise MissingDependencyError("torch", "train") from error


def roadmap_labels(simulation: Simulation) -> Array:
    """Return the actions (n, joints) that follow each simulation's roadmap; NaN where no waypoint is visible."""
    command, state = simulation.command, simulation.state
    assert state is not None
    steps: Array = simulation.action_rule.peak  # type: ignore[attr-defined]
    labels = np.full(command.shape, np.nan)
    for i, (offset, free) in enumerate(zip(state.waypoint, state.path_free, strict=True)):
        if free:
            labels[i] = action_towards(command[i] + offset, command[i], steps)
    return labels


_LABELS: dict[str, Callable[[Simulation], Array]] = {"roadmap": roadmap_labels, "picking": picking_labels}


def follow_waypoint(policy: Any) -> None:
    """Initialize the actor of an untrained Stable-Baselines3 policy so that it acts exactly as the agent ``roadmap``.

    The first hidden units carry the positive and the negative part of the waypoint's direction while the waypoint is
    free. The others keep their weights but have no effect on the action until they learn.

    Args:
        policy: An actor-critic policy with rectified linear units on `ScaledObservation` of ``"roadmap"``.

    Raises:
        InvalidValueError: Its activation differs, its layers are too narrow, or it observes no waypoint.
    """
    extractor, actions = policy.pi_features_extractor, policy.action_net
    joints = actions.out_features
    starts = getattr(extractor, "starts", {})
    direction, path = (starts.get(name, -1) for name in ("waypoint_direction", "path"))
    layers = [layer for layer in policy.mlp_extractor.policy_net if hasattr(layer, "in_features")]
    if direction < 0 or policy.activation_fn is not torch.nn.ReLU or min(p.out_features for p in layers) < 2 * joints:
        raise InvalidValueError(
            f'to follow waypoints, a policy needs observation="roadmap", activation="relu" and hidden layers of at '
            f"least {2 * joints} units"
        )
    units = torch.arange(2 * joints)
    carried, free = direction + units % joints, path + 1
    with torch.no_grad():
        for layer in layers:
            layer.weight[units], layer.bias[units] = 0.0, 0.0
        # directions are at most 1: after subtracting 1 where the waypoint is not free, nothing positive is left
        layers[0].weight[units, carried] = torch.where(units < joints, 1.0, -1.0) * extractor.scale[carried]
        layers[0].weight[units, free] = extractor.scale[free]
        layers[0].bias[units] = extractor.center[free] - 1.0
        for layer in layers[1:]:
            layer.weight[units, units] = 1.0
        actions.weight.zero_()
        actions.bias.zero_()
        actions.weight[units % joints, units] = torch.where(units < joints, 1.0, -1.0)


def imitate(
    policy: Any,
    env: GreenhouseVectorEnv,
    settings: ImitationSettings,
    seed: int = 0,
    on_progress: Callable[[int, dict[str, float]], None] = lambda steps, figures: None,
) -> None:
    """Train the actor of a Stable-Baselines3 policy to act like the teacher.

    Args:
        policy: An actor-critic policy; its actor and features are trained.
        env: Vector environment with ``autoreset_mode="SameStep"`` and the arm and observation of the policy; for the
            teacher "roadmap" it includes waypoints.
        settings: The settings.
        seed: Seed of episodes and noise.
        on_progress: Called with the steps so far and figures after each round.
    """
    seed = require_seed(seed)
    rng = np.random.default_rng(seed)
    torch.manual_seed(seed)
    parameters = [*policy.mlp_extractor.policy_net.parameters(), *policy.action_net.parameters()]
    optimizer: Any = torch.optim.Adam(parameters, lr=settings.learning_rate)
    rounds = max(1, settings.steps // (settings.num_envs * settings.round_steps))
    observed, _ = env.reset(seed=seed)
    teacher_acts = np.ones(env.num_envs, dtype=np.bool_)
    inputs: list[Observed] = []
    labels: list[Array] = []
    labels_of = _LABELS[settings.teacher]
    updates = settings.steps * settings.passes // (settings.batch_size * rounds)
    for k in range(rounds):
        beta = max(0.0, 1.0 - k / max(1.0, settings.beta_fraction * rounds))
        ended = successes = 0
        began = time.perf_counter()
        for _ in range(settings.round_steps):
            label = labels_of(env.simulation)
            known = np.isfinite(label[:, 0])
            inputs.append(observed[known])  # type: ignore[index]
            labels.append(label[known])
            own = _mean(policy, observed)
            action = np.where((teacher_acts & known)[:, None], label, own)
            action = action + settings.noise * rng.normal(size=action.shape)
            observed, _, terminated, truncated, infos = env.step(action)
            for i in np.flatnonzero(terminated | truncated).tolist():
                if not teacher_acts[i]:
                    ended, successes = ended + 1, successes + bool(infos["final_info"]["is_success"][i])
                teacher_acts[i] = rng.random() < beta
        collected = time.perf_counter() - began
        rate = settings.learning_rate * (0.1 + 0.9 * (1 - k / rounds))
        for group in optimizer.param_groups:
            group["lr"] = rate
        x = torch.as_tensor(np.concatenate(inputs))  # type: ignore[arg-type]
        y = torch.as_tensor(np.concatenate(labels), dtype=torch.float32)
        loss = 0.0
        for _ in range(updates):
            batch = torch.as_tensor(rng.integers(len(x), size=settings.batch_size))
            error: Any = (_forward(policy, x[batch]) - y[batch]).abs().mean()
            optimizer.zero_grad()
            error.backward()
            optimizer.step()
            loss += float(error.detach()) / updates
        seconds = time.perf_counter() - began - collected
        figures = {
            "loss": loss, "success": successes / max(1, ended), "episodes": float(ended), "labels": float(len(x)),
            "collecting": collected, "training": seconds,
        }  # fmt: skip
        on_progress((k + 1) * settings.num_envs * settings.round_steps, figures)


def _forward(policy: Any, inputs: torch.Tensor) -> torch.Tensor:
    return policy.action_net(policy.mlp_extractor.forward_actor(policy.pi_features_extractor(inputs)))


def _mean(policy: Any, observed: Any) -> Array:
    with torch.no_grad():
        return np.asarray(_forward(policy, torch.as_tensor(observed)).numpy(), dtype=np.float64)


def train_bc_then_ppo(
    settings: BcThenPpoSettings,
    out: str | Path,
    *,
    resume: bool = False,
    on_progress: Callable[[int, dict[str, float]], None] = lambda steps, figures: None,
) -> Path:
    """Train a policy; ``out`` gets the files of `greenhouse_gym.learning.train_ppo` and the varied scenes.

    Args:
        settings: The settings.
        out: Folder for the results.
        resume: Continue from the checkpoint in ``out``, with PPO.
        on_progress: Called with the steps and figures of the imitation after each round.

    Returns:
        The path of the policy's JSON file.
    """
    out, ppo = Path(out), settings.ppo
    if settings.variations:
        plain, ppo = SceneBank.open(ppo.bank), replace(ppo, bank=str((out / "bank").resolve()))
        check_start(out, as_json(ppo), resume)
        with exclusive(out):
            varied_bank(plain, out / "bank", settings.variations, ppo.seed)

    def teach(model: Any) -> None:
        options = {
            name: getattr(ppo, name)
            for name in (
                "bank", "split", "robot", "observation", "action", "task", "plants", "difficulty", "scene", "target",
                "threads",
            )
        } | physics_of(ppo)  # fmt: skip
        if settings.from_rule:
            follow_waypoint(model.policy)
        if not settings.imitation.steps:
            return
        env = make_vec_env(settings.imitation.num_envs, autoreset_mode="SameStep", **options)
        with closing(env):
            imitate(model.policy, env, settings.imitation, ppo.seed, on_progress)

    return train_ppo(ppo, out, resume=resume, prepare=teach)
