"""Settings of the trainings; they are checked without importing PyTorch."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field

from greenhouse_gym.common.settings_files import Count, Fraction, PositiveCount, check_numbers
from greenhouse_gym.errors import InvalidValueError, check_whole, require_choice
from greenhouse_gym.learning.training_settings import (
    Choice,
    Layers,
    Rate,
    SceneChoice,
    Seed,
    Simulations,
    Threads,
    check_settings,
    require_joint_action,
)

TEACHERS = ("roadmap", "picking")
"""Names of the teachers of an imitation."""

ACTIVATIONS = ("tanh", "relu")
"""Names of the activation functions."""


@dataclass(frozen=True)
class PpoSettings:
    """Settings of a training by PPO.

    Attributes:
        bank: Name or folder of the scene bank.
        split: Split to train on.
        sources: Sources of the rows to train on, such as "own" or "helios"; all if empty.
        robot: The arm.
        observation: Observation of the environment, by name or your own; "roadmap" has a planner in it.
        action: Action of the environment, by name or your own.
        reward: Reward of the environment, by name or your own; "path" has a planner in it.
        task: Task of the environment, by name or your own.
        plants: "rigid", "brush" for leaves that give way, or "compliant" for the true rows of the task "harvest".
        difficulty: Difficulties of the targets.
        scene: Name of the only scene to train on; all scenes of the split if None.
        target: Index of its only tomato to train on; needs a scene.
        total_steps: Steps of all simulations together.
        num_envs: Number of simulations.
        rollout_steps: Steps of each simulation between updates.
        batch_size: Samples per gradient step.
        epochs: Passes over a rollout.
        learning_rate: Learning rate at the start; it falls linearly to zero.
        discount: Discount of future rewards, per step.
        gae_lambda: Lambda of the generalized advantage estimate.
        clip_range: Largest deviation of the probability ratio from 1.
        log_std: Initial logarithm of the standard deviation of the action noise.
        hidden: Sizes of the hidden layers of actor and critic.
        activation: Activation function between the layers, "tanh" or "relu".
        restart_steps: Steps of each simulation, fewer at first, after which all begin new episodes, and a checkpoint
            can be written from which a killed training resumes to the same policy.
        critic_rollouts: Rollouts at the beginning that train the critic alone, so that an untrained critic does not
            spoil a policy that is already good.
        validation_steps: Steps between validations: episodes on rows not trained on, without the policy's noise; 0 for
            none.
        validation_episodes: Episodes of each validation, the same ones every time.
        seed: Seed of scenes, weights and noise.
        threads: Threads of the simulation; 0 uses all cores. The network has one: on a busy machine, more threads
            mostly wait for each other.
    """

    bank: str = "default"
    split: str = "train"
    sources: tuple[str, ...] = ()
    robot: str = "ur5e"
    observation: Choice = "state"
    action: Choice = "tip_velocity"
    reward: Choice = "dense"
    task: Choice = "reach"
    plants: str = "rigid"
    difficulty: str | tuple[str, ...] | dict[str, float] = ("easy", "medium", "hard")
    scene: SceneChoice = None
    target: int | None = None
    total_steps: Count = 2_000_000
    num_envs: Simulations = 128
    rollout_steps: PositiveCount = 64
    batch_size: Annotated[int, Field(ge=2)] = 2048
    epochs: PositiveCount = 6
    learning_rate: Rate = 5e-4
    discount: Fraction = 0.99
    gae_lambda: Fraction = 0.95
    clip_range: Rate = 0.2
    log_std: Annotated[float, Field(ge=-20, le=2, allow_inf_nan=False)] = -1.0
    hidden: Layers = (256, 256)
    activation: str = "relu"
    restart_steps: PositiveCount = 1000
    critic_rollouts: int = 0
    validation_steps: int = 0
    validation_episodes: PositiveCount = 100
    seed: Seed = 0
    threads: Threads = 0

    def __post_init__(self) -> None:
        check_settings(self)
        require_choice("activation", self.activation, ACTIVATIONS)
        if self.rollout_steps * self.num_envs < 2:
            raise InvalidValueError("rollout_steps times num_envs must be at least 2, got 1")


@dataclass(frozen=True)
class DevicePpoSettings:
    """Settings of a training by PPO on a device.

    Attributes:
        bank: Name or folder of the scene bank.
        split: Split to train on.
        sources: Sources of the rows to train on, such as "own" or "helios"; all if empty.
        robot: The arm.
        action: "joint", "joint_velocity" or "tip_velocity".
        goals: Number of goal configurations of each target among which the critic chooses as an episode begins, see
            `greenhouse_gym.agents.GoalChoosingAgent`; 0 for a policy that observes none. They need joint actions and
            the CPU. Inverse kinematics finds them before the training begins, in one to three minutes.
        difficulty: Difficulties of the targets.
        scene: Name of the only scene to train on; all of the split if None.
        target: The only tomato of the scene to train on.
        device: "cpu" or "cuda".
        total_steps: Steps of all simulations together.
        num_envs: Number of simulations; 0 for 4,096 on a GPU and 512 on a CPU.
        rollout_steps: Steps of each simulation between updates; 0 for 24 on a GPU and 32 on a CPU.
        minibatches: Gradient steps per pass over a rollout.
        epochs: Passes over a rollout; 0 for 4 on a GPU and 2 on a CPU, where they cost more than new steps.
        learning_rate: Learning rate at the start; it falls linearly to zero over the steps or the time of the training.
        divergence: Desired Kullback-Leibler divergence of the policy from the one before the update. While it is twice
            as large, the learning rate is lowered.
        discount: Discount of future rewards, per step.
        gae_lambda: Lambda of the generalized advantage estimate.
        clip_range: Largest deviation of the probability ratio from 1.
        collision: Reward for a collision; the other terms are those of `DenseReward`.
        log_std: Initial logarithm of the standard deviation of the action noise.
        hidden: Sizes of the hidden layers of actor and critic; if empty, 2 of 256 on a GPU and 2 of 128 on a CPU.
        seed: Seed of episodes, weights and noise.
    """

    bank: str = "default"
    split: str = "train"
    sources: tuple[str, ...] = ()
    robot: str = "ur5e"
    action: str = "tip_velocity"
    goals: int = 0
    difficulty: tuple[str, ...] = ("easy", "medium", "hard")
    scene: str | None = None
    target: int | None = None
    device: str = "cpu"
    total_steps: int = 100_000_000
    num_envs: int = 0
    rollout_steps: int = 0
    minibatches: int = 8
    epochs: int = 0
    learning_rate: float = 1e-3
    divergence: float = 0.012
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    collision: float = -5.0
    log_std: float = -0.5
    hidden: tuple[int, ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        sizes = (512, 32, 2, (128, 128)) if self.device == "cpu" else (4096, 24, 4, (256, 256))
        for name, size in zip(("num_envs", "rollout_steps", "epochs", "hidden"), sizes, strict=True):
            object.__setattr__(self, name, getattr(self, name) or size)
        check_whole("goals", self.goals, 0)


@dataclass(frozen=True)
class SacSettings:
    """Settings of a training by SAC.

    Attributes:
        bank: Name or folder of the scene bank; its training split is trained on.
        robot: The arm.
        difficulty: Difficulties of the targets.
        observation: "goal", or "goal_roadmap", which adds the next waypoint of a collision-free path, or your own with
            goals.
        action: Action of the environment, by name or your own.
        reward: "dense", "sparse" or your own. With the sparse one a collision costs what a success pays, so arms that
            still collide often learn to keep away from the plants; it learned little.
        task: Task of the environment, by name or your own; one with goals.
        plants: As for PPO.
        scene: Name of the only scene to train on; all scenes of the split if None.
        target: Index of its only tomato to train on; needs a scene.
        num_envs: Number of simulations.
        updates_per_step: Gradient steps per step of all simulations.
        batch_size: Transitions per gradient step.
        learning_rate: Learning rate of actor, critics and entropy coefficient.
        discount: Discount of future rewards, per step.
        target_rate: Fraction by which the target critics move towards the critics per gradient step.
        entropy_coefficient: Initial value; it adapts. With a much higher one, acting at random pays more than a
            success, which ends the episode.
        hindsight_goals: Transitions with a goal in hindsight per real one.
        memory: Number of transitions in the replay buffer.
        random_steps: Steps with random actions before the first gradient step; at least one episode per simulation.
        guided: True to follow the waypoint in these steps instead, exactly in the first simulation and with most noise
            in the last, and to constrain the actor towards that rule.
        guide_weight: Weight of that constraint against the critics; see `GuidedSAC`.
        total_steps: Steps of all simulations together.
        validation_steps: Steps between validations on rows that are trained on and on rows that are not, without the
            policy's noise.
        validation_episodes: Episodes of each validation and split, the same ones every time.
        hidden: Sizes of the hidden layers of actor and critics.
        seed: Seed of scenes, weights and noise.
        threads: Threads of the simulation; 0 uses all cores. The network has one: on a busy machine, more threads
            mostly wait for each other.
    """

    bank: str = "mini"
    robot: str = "ur5e"
    difficulty: str | tuple[str, ...] | dict[str, float] = ("easy",)
    observation: Choice = "goal"
    action: Choice = "tip_velocity"
    reward: Choice = "dense"
    task: Choice = "reach"
    plants: str = "rigid"
    scene: SceneChoice = None
    target: int | None = None
    num_envs: Simulations = 32
    updates_per_step: PositiveCount = 8
    batch_size: PositiveCount = 256
    learning_rate: Rate = 1e-3
    discount: Fraction = 0.97
    target_rate: Fraction = 0.02
    entropy_coefficient: Rate = 0.05
    hindsight_goals: Count = 2
    memory: PositiveCount = 400_000
    random_steps: int = 6_600
    guided: bool = False
    guide_weight: float = 2.0
    total_steps: PositiveCount = 1_000_000
    validation_steps: int = 20_000
    validation_episodes: Annotated[int, Field(ge=1, le=1 << 16)] = 100
    hidden: Layers = (256, 256)
    seed: Seed = 0
    threads: Threads = 0

    def __post_init__(self) -> None:
        weight = self.guide_weight
        if not isinstance(weight, float | int) or not 0 <= weight <= sys.float_info.max:
            raise InvalidValueError(f"guide_weight must be a finite number from 0 on, got {weight!r}")
        check_settings(self)


@dataclass(frozen=True)
class ImitationSettings:
    """Settings of an imitation.

    Attributes:
        steps: Labeled steps of all simulations together.
        num_envs: Number of simulations.
        teacher: "roadmap", which joint actions can follow, or "picking", motions of the tip in the task "harvest".
        round_steps: Steps of each simulation between two trainings.
        beta_fraction: Fraction of the steps over which DAgger's beta, the probability that the teacher acts in an
            episode, falls from one to zero.
        noise: Standard deviation of the noise on the actions taken; labels have none.
        passes: Average number of times that training uses a label.
        batch_size: Labels per gradient step.
        learning_rate: Learning rate at the start; it falls to a tenth.
    """

    steps: int = 200_000
    teacher: str = "roadmap"
    num_envs: Simulations = 64
    round_steps: PositiveCount = 50
    beta_fraction: Fraction = 0.3
    noise: float = 0.1
    passes: int = 24
    batch_size: PositiveCount = 1024
    learning_rate: Rate = 1e-3

    def __post_init__(self) -> None:
        check_numbers(self)
        require_choice("teacher", self.teacher, TEACHERS)


FINE_TUNING = PpoSettings(
    observation="roadmap", action="joint", log_std=-2.5, learning_rate=5e-5, batch_size=4096, epochs=4,
    critic_rollouts=8,
)  # fmt: skip
"""Settings of PPO for a policy that is already good: little noise, small steps, the critic first."""


@dataclass(frozen=True)
class BcThenPpoSettings:
    """Settings of a training by imitation and PPO.

    Attributes:
        variations: Number of varied scenes to add to the bank's training scenes.
        imitation: Settings of the imitation; with 0 steps it is skipped.
        ppo: Settings of PPO and of the network; with 0 steps PPO is skipped.
        from_rule: True to initialize the network as the rule that follows waypoints, False for random weights.
    """

    variations: int = 0
    imitation: ImitationSettings = field(default_factory=ImitationSettings)
    ppo: PpoSettings = FINE_TUNING
    from_rule: bool = True

    def __post_init__(self) -> None:
        check_numbers(self)
        if self.imitation.teacher == "picking":
            _check_picking(self)
        elif self.from_rule or self.imitation.steps:
            require_joint_action("imitation", self.ppo.action)


def _check_picking(settings: BcThenPpoSettings) -> None:
    """Raise an error for settings that the teacher of picking cannot teach.

    Raises:
        InvalidValueError: Another task or action, or a policy that follows waypoints.
    """
    ppo = settings.ppo
    if (ppo.task, ppo.plants, ppo.action, settings.from_rule) != ("harvest", "compliant", "tip_velocity", False):
        raise InvalidValueError(
            'teacher "picking" needs task="harvest", plants="compliant", action="tip_velocity", from_rule=False; got '
            f"{ppo.task!r}, {ppo.plants!r}, {ppo.action!r} and {settings.from_rule}"
        )
