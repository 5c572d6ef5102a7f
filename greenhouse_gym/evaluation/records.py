"""Episode records, statistics over them, and comparison tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from html import escape
from itertools import combinations
from statistics import mean, median
from typing import Any

from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.tables import Table, number
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene import DIFFICULTIES

SIGNIFICANT = 0.05
"""Probability of a difference by chance below which two agents count as different."""


@dataclass(frozen=True)
class Record:
    """Record of one episode.

    Attributes:
        seed: Seed of the episode.
        scene: Name of the scene.
        target: Index of the target tomato.
        difficulty: Its rating.
        success: The episode ended with success.
        collision: The episode ended with a collision.
        contact: Names of the two geoms of the first contact, the arm's first; empty without a contact.
        steps: Actions taken.
        planning_time: Time that the agent took at the start of the episode, seconds.
        action_time: Mean time that the agent took per action, with its own observation and kind of action, seconds.
        joint_length: Length of the joint path, radians (Euclidean norm).
        tip_length: Length of the tip's path, metres.
        clearance: Smallest distance between the arm and any obstacle except the target at the ends of the actions,
            metres, at most `CLEARANCE_RANGE`. Floor, cart and the arm itself do not count.
        roughness: Mean norm of the change in joint steps between consecutive actions, radians; 0 is smoothest.
        total_reward: Sum of the rewards.
        distance: Remaining distance at the end, metres; for reaching, from the grasp point to the target's center.
        status: The agent's status of its plan; empty for agents that do not plan.
        failure: Reason why the agent gave no valid action, which ended the episode; empty otherwise.
        measures: Numbers that the task remembers, at the end of the episode, by name; see `greenhouse_gym.envs.Task`.
        rules: Settings by which the agent's ``env_options`` changed the rules of the episode, such as
            "success_radius=1.0"; empty otherwise.
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
    measures: dict[str, float] = field(default_factory=dict, hash=False)
    rules: str = ""


@dataclass(frozen=True)
class Evaluation:
    """Records of an agent's episodes.

    Attributes:
        agent: The agent's name.
        records: One per episode.
        error: Reason why the agent could not be evaluated; empty otherwise.
    """

    agent: str
    records: tuple[Record, ...]
    error: str = ""

    @property
    def success_rate(self) -> float:
        """Fraction of successful episodes; NaN without episodes."""
        return mean(r.success for r in self.records) if self.records else math.nan

    @property
    def collision_rate(self) -> float:
        """Fraction of episodes that ended with a collision; NaN without episodes."""
        return mean(r.collision for r in self.records) if self.records else math.nan

    @property
    def success_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the success rate (Wilson)."""
        return wilson_interval(sum(r.success for r in self.records), len(self.records))

    @property
    def rules(self) -> str:
        """Settings by which the agent changed the rules of its episodes, see `Record.rules`."""
        return "; ".join(dict.fromkeys(r.rules for r in self.records if r.rules))

    @property
    def failures(self) -> int:
        """Number of episodes that ended because the agent gave no valid action."""
        return sum(bool(r.failure) for r in self.records)

    def __repr__(self) -> str:
        figures = (
            f"success {self.success_rate:.1%}, collision {self.collision_rate:.1%}" if self.records else self.error
        )
        return f"Evaluation({self.agent!r}, {len(self.records)} episodes, {figures})"

    def _repr_html_(self) -> str:
        return comparison_html((self,))

    def to_pandas(self) -> Any:
        """Return a data frame with a row per episode: the agent and the fields of `Record`.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        return records_frame((self,))

    def of(self, difficulty: str) -> Evaluation:
        """Return the evaluation restricted to one difficulty."""
        return Evaluation(self.agent, tuple(r for r in self.records if r.difficulty == difficulty))

    def median(self, field: str, solved_only: bool = False) -> float:
        """Return the median of a record field over all or the successful episodes; NaN without any."""
        values = [float(getattr(r, field)) for r in self.records if r.success or not solved_only]
        return median(values) if values else math.nan


class Evaluations(tuple[Evaluation, ...]):
    """Evaluations of several agents on the same episodes, which notebooks show as a table."""

    __slots__ = ()

    def __repr__(self) -> str:
        return comparison_table(self)

    def _repr_html_(self) -> str:
        return comparison_html(self)

    def to_pandas(self) -> Any:
        """Return a data frame with a row per agent and episode, as `Evaluation.to_pandas`.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        return records_frame(self)


def records_frame(evaluations: Sequence[Evaluation]) -> Any:
    """Return a pandas data frame with a row per record."""
    with needs("train"):
        import pandas
    columns = ["agent", *(f.name for f in fields(Record))]
    rows = [[e.agent, *(getattr(r, name) for name in columns[1:])] for e in evaluations for r in e.records]
    return pandas.DataFrame(rows, columns=columns)


@dataclass(frozen=True)
class Pairing:
    """Paired comparison of two agents on the same episodes.

    Attributes:
        first: Name of the first agent.
        second: Name of the second agent.
        episodes: Number of episodes that both agents ran.
        only_first: Number of episodes in which only the first agent succeeded.
        only_second: Number of episodes in which only the second agent succeeded.
        p_value: Probability of a difference at least this large if the agents are equally good (McNemar's exact test).
    """

    first: str
    second: str
    episodes: int
    only_first: int
    only_second: int
    p_value: float

    def __str__(self) -> str:
        verdict = "differ" if self.p_value < SIGNIFICANT else "may be equally good"
        return (
            f"{self.first} and {self.second} {verdict}: only the first succeeded in {self.only_first}, only the second "
            f"in {self.only_second} of {self.episodes} episodes, McNemar p = {self.p_value:.2g}"
        )


def pairing(first: Evaluation, second: Evaluation) -> Pairing:
    """Compare two agents by McNemar's exact test (1947) on the episodes that both ran, under the same rules.

    Raises:
        InvalidValueError: They have no episode in common.
    """
    theirs = {_episode(r): r.success for r in second.records}
    both = [(r.success, theirs[_episode(r)]) for r in first.records if _episode(r) in theirs]
    if not both:
        raise InvalidValueError(f"{first.agent} and {second.agent} have no episode in common")
    ours, others = both.count((True, False)), both.count((False, True))
    p_value = 1.0
    if ours + others:
        from scipy.stats import binomtest  # takes a second

        p_value = float(binomtest(ours, ours + others).pvalue)
    return Pairing(first.agent, second.agent, len(both), ours, others, p_value)


def differences(evaluations: Sequence[Evaluation]) -> str:
    """Return one line on which agents differ by more than chance; empty for fewer than two agents with records."""
    pairs = pairings(evaluations)
    if len(pairs) < 2:
        return "".join(map(str, pairs))
    beaten: dict[str, list[str]] = {}
    for pair in pairs:
        if pair.p_value < SIGNIFICANT:
            better, worse = pair.first, pair.second
            if pair.only_second > pair.only_first:
                better, worse = worse, better
            beaten.setdefault(better, []).append(worse)
    if not beaten:
        return f"No two agents differ by more than chance (McNemar, smallest p = {min(p.p_value for p in pairs):.2g})"
    found = "; ".join(f"{better} beats {', '.join(worse)}" for better, worse in beaten.items())
    rest = len(pairs) - sum(map(len, beaten.values()))
    others = "; other pairs may be equally good" if rest else ""
    return f"By more than chance (McNemar, p < {SIGNIFICANT}): {found}{others}"


def pairings(evaluations: Sequence[Evaluation]) -> list[Pairing]:
    """Compare every two agents that have episodes in common."""
    episodes = {id(e): {_episode(r) for r in e.records} for e in evaluations}
    return [pairing(a, b) for a, b in combinations(evaluations, 2) if not episodes[id(a)].isdisjoint(episodes[id(b)])]


def _episode(record: Record) -> tuple[int, str, int, str]:
    return record.seed, record.scene, record.target, record.rules


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a rate (Wilson, 1927); (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    from scipy.stats import binomtest  # takes a second

    interval = binomtest(successes, trials).proportion_ci(confidence_level=0.95, method="wilson")
    return float(interval.low), float(interval.high)


def comparison_table(evaluations: Sequence[Evaluation]) -> str:
    """Return the table of `comparison_rows` as Markdown, with `comparison_notes` below it."""
    notes = "".join(f"\n{note}\n" for note in comparison_notes(evaluations))
    return comparison_rows(evaluations).as_markdown() + notes


def comparison_html(evaluations: Sequence[Evaluation]) -> str:
    """Return the table of `comparison_rows` as HTML, with `comparison_notes` below it."""
    notes = "".join(f"<p>{escape(note)}</p>" for note in comparison_notes(evaluations))
    return comparison_rows(evaluations).as_html() + notes


def difficulties_of(evaluations: Sequence[Evaluation]) -> list[str]:
    """Return the difficulties that occur in the records, easiest first."""
    present = {r.difficulty for e in evaluations for r in e.records}
    return [d for d in DIFFICULTIES if d in present]


def comparison_rows(evaluations: Sequence[Evaluation]) -> Table:
    """Return a table with a row per agent; lengths, steps and clearances are medians over the successful episodes."""
    difficulties = difficulties_of(evaluations)
    heads = ["agent", "episodes", "success [95 %]", *difficulties, "collision", "planning s", "steps"]
    heads += ["joints rad", "tip m", "clearance mm", "roughness rad"]
    rows = []
    for e in evaluations:
        low, high = e.success_interval
        rows.append(
            [
                f"{e.agent} *" if e.rules else e.agent,
                str(len(e.records)),
                f"{e.success_rate:.1%} [{100 * low:.1f}, {100 * high:.1f}]" if e.records else "",
                *(number(e.of(difficulty).success_rate, ".0%") for difficulty in difficulties),
                number(e.collision_rate, ".1%"),
                number(e.median("planning_time"), ".3f"),
                number(e.median("steps", solved_only=True), ".0f"),
                number(e.median("joint_length", solved_only=True), ".2f"),
                number(e.median("tip_length", solved_only=True), ".2f"),
                number(1000 * e.median("clearance", solved_only=True), ".1f"),
                number(e.median("roughness", solved_only=True), ".4f"),
            ]
        )
    return Table(heads, rows)


def comparison_notes(evaluations: Sequence[Evaluation]) -> list[str]:
    """Return notes on agents that could not be evaluated, changed the rules, or gave no valid action."""
    notes = [f"{e.agent}: {e.error}" for e in evaluations if e.error]
    notes += [f"* {e.agent} changed the rules of its episodes: {e.rules}" for e in evaluations if e.rules]
    for e in evaluations:
        if e.failures:
            first = next(r for r in e.records if r.failure)
            notes.append(f"{e.agent}: {e.failures} episodes ended without a valid action; the first: {first.failure}")
    return notes
