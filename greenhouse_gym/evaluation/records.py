"""What is recorded of an agent's episodes, and the table made of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean, median

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene import DIFFICULTIES


@dataclass(frozen=True)
class Record:
    """One episode.

    Attributes:
        seed: Seed of the episode.
        scene: Name of the scene.
        target: Index of the target tomato.
        difficulty: Its rating.
        success: The target was reached and nothing was touched.
        collision: Something was touched.
        contact: Names of the geoms that touched, the arm's first; empty without a collision.
        steps: Actions taken.
        planning_time: Seconds the agent took at the episode's start.
        action_time: Seconds the agent took per action, on average.
        joint_length: Way of the joints, radians (Euclidean norm).
        tip_length: Way of the tip, metres.
        clearance: Smallest distance of the arm to any obstacle but the target, metres, at the ends of the actions;
            at most `CLEARANCE_RANGE`. Floor, cart and the arm itself do not count.
        roughness: Mean norm of the change of the joint steps from action to action, radians; 0 is smoothest.
        total_reward: Sum of the rewards.
        distance: From the grasp point to the target's center at the end, metres.
        status: What the agent says of its plan; empty for agents that do not plan.
        failure: Why the agent gave no valid action, which ended the episode; empty where it always did.
    """

    seed: int
    scene: str
    target: int
    difficulty: str
    success: bool
    collision: bool
    contact: tuple[str, ...]
    steps: int
    planning_time: float
    action_time: float
    joint_length: float
    tip_length: float
    clearance: float
    roughness: float
    total_reward: float
    distance: float
    status: str = ""
    failure: str = ""


@dataclass(frozen=True)
class Evaluation:
    """An agent's episodes.

    Attributes:
        agent: The agent's name.
        records: One per episode.
        error: Why the agent could not be evaluated; empty where it was.
    """

    agent: str
    records: tuple[Record, ...]
    error: str = ""

    @property
    def success_rate(self) -> float:
        """Share of successful episodes; nan without episodes."""
        return mean(r.success for r in self.records) if self.records else math.nan

    @property
    def collision_rate(self) -> float:
        """Share of episodes that ended with a collision; nan without episodes."""
        return mean(r.collision for r in self.records) if self.records else math.nan

    @property
    def success_interval(self) -> tuple[float, float]:
        """95 % interval of the success rate (Wilson)."""
        return wilson_interval(sum(r.success for r in self.records), len(self.records))

    @property
    def failures(self) -> int:
        """Number of episodes that ended because the agent gave no valid action."""
        return sum(bool(r.failure) for r in self.records)

    def of(self, difficulty: str) -> Evaluation:
        """The episodes of one difficulty."""
        return Evaluation(self.agent, tuple(r for r in self.records if r.difficulty == difficulty))

    def median(self, field: str, solved_only: bool = False) -> float:
        """Median of a number of the records, over all episodes or the successful ones; nan where there are none."""
        values = [float(getattr(r, field)) for r in self.records if r.success or not solved_only]
        return median(values) if values else math.nan


@dataclass(frozen=True)
class Pairing:
    """How two agents did on the same episodes.

    Attributes:
        first: Name of the first agent.
        second: Name of the second agent.
        episodes: Episodes that both played.
        only_first: Episodes in which the first alone succeeded.
        only_second: Episodes in which the second alone succeeded.
        p_value: Result of McNemar's exact test: how likely a difference like this is if the agents are equally good.
    """

    first: str
    second: str
    episodes: int
    only_first: int
    only_second: int
    p_value: float

    def __str__(self) -> str:
        verdict = "differ" if self.p_value < 0.05 else "may be equally good"
        return (
            f"{self.first} and {self.second} {verdict}: alone successful in {self.only_first} and {self.only_second} "
            f"of {self.episodes} episodes, McNemar p = {self.p_value:.2g}"
        )


def pairing(first: Evaluation, second: Evaluation) -> Pairing:
    """Compare two agents by McNemar's exact test (1947) on the episodes that both played.

    Raises:
        InvalidValueError: They played no episode in common.
    """
    theirs = {(r.seed, r.scene, r.target): r.success for r in second.records}
    both = [(r.success, theirs[key]) for r in first.records if (key := (r.seed, r.scene, r.target)) in theirs]
    if not both:
        raise InvalidValueError(f"{first.agent} and {second.agent} played no episode in common")
    ours, others = both.count((True, False)), both.count((False, True))
    p_value = 1.0
    if ours + others:
        from scipy.stats import binomtest  # takes a second

        p_value = float(binomtest(ours, ours + others).pvalue)
    return Pairing(first.agent, second.agent, len(both), ours, others, p_value)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % confidence interval of a rate (Wilson, 1927); (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    from scipy.stats import binomtest  # takes a second

    interval = binomtest(successes, trials).proportion_ci(confidence_level=0.95, method="wilson")
    return float(interval.low), float(interval.high)


def comparison_table(evaluations: Sequence[Evaluation]) -> str:
    """A Markdown table of `comparison_rows`, with `comparison_notes` below it."""
    heads, *rows = comparison_rows(evaluations)
    rows = [heads, ["---"] + ["---:"] * (len(heads) - 1), *rows]
    table = "".join("| " + " | ".join(row) + " |\n" for row in rows)
    return table + "".join(f"\n{note}\n" for note in comparison_notes(evaluations))


def difficulties_of(evaluations: Sequence[Evaluation]) -> list[str]:
    """The difficulties that were played, the easiest first."""
    present = {r.difficulty for e in evaluations for r in e.records}
    return [d for d in DIFFICULTIES if d in present]


def comparison_rows(evaluations: Sequence[Evaluation]) -> list[list[str]]:
    """The heads of a table and a row per agent; ways, steps and clearances are medians over the successful episodes."""
    difficulties = difficulties_of(evaluations)
    heads = ["agent", "episodes", "success [95 %]", *difficulties, "collision", "planning s", "steps"]
    rows = [[*heads, "joints rad", "tip m", "clearance mm", "roughness rad"]]
    for e in evaluations:
        low, high = e.success_interval
        rows.append(
            [
                e.agent,
                str(len(e.records)),
                f"{e.success_rate:.1%} [{low:.1%}, {high:.1%}]",
                *(f"{e.of(difficulty).success_rate:.1%}" for difficulty in difficulties),
                f"{e.collision_rate:.1%}",
                f"{e.median('planning_time'):.3f}",
                f"{e.median('steps', solved_only=True):.0f}",
                f"{e.median('joint_length', solved_only=True):.2f}",
                f"{e.median('tip_length', solved_only=True):.2f}",
                f"{1000 * e.median('clearance', solved_only=True):.1f}",
                f"{e.median('roughness', solved_only=True):.4f}",
            ]
        )
    return rows


def comparison_notes(evaluations: Sequence[Evaluation]) -> list[str]:
    """Which agents could not be evaluated, and which gave no valid action in some episodes."""
    notes = [f"{e.agent}: {e.error}" for e in evaluations if e.error]
    for e in evaluations:
        if e.failures:
            first = next(r for r in e.records if r.failure)
            notes.append(f"{e.agent}: {e.failures} episodes ended without a valid action, first {first.failure}")
    return notes
