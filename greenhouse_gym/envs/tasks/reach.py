"""Task `reach`: bring the tool to a tomato without touching anything else. It is the task of ``TomatoReach-v0``."""

from __future__ import annotations

from dataclasses import dataclass

from greenhouse_gym.envs.state import Bools, State, lengths
from greenhouse_gym.envs.task import GoalTask, Outcome
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.success import SUCCESS_RADIUS, is_reached


@dataclass(frozen=True)
class TomatoReach(GoalTask):
    """Reach a tomato with the tool of an arm and touch nothing else.

    **Success.** The grasp point is within 2 cm (``success_radius``) of the target's center, and no physics step of the
    action had a contact other than of the cup with the target, which is allowed. Every other contact is a
    **collision**. Both terminate the episode.

    **Reward**, the sum of the terms in ``info["reward_terms"]``:

    | term | ``dense`` | ``path`` | ``sparse`` |
    |---|---|---|---|
    | ``success`` | +10 | +10 | +1 |
    | ``collision`` | -5 | -1 | -1 |
    | ``progress`` | 4 per metre the grasp point came nearer | 2 per radian of the path | |
    | ``time`` | -0.02 | -0.02 | |
    | ``effort`` | -0.003 times the sum of the action's squares | as ``dense`` | |

    ``path`` measures progress along the path of the observation ``roadmap`` in joint space: to the waypoint and on to
    the goal. It works with any observation, but not in goal environments.

    **Goals.** With ``observation="goal"`` or ``"goal_roadmap"``, the achieved goal is the grasp point and the desired
    goal the target's center.

    Attributes:
        success_radius: Maximum distance of the grasp point from the target's center, metres.
    """

    success_radius: float = SUCCESS_RADIUS

    def goals(self, state: State) -> tuple[Array, Array]:
        """Return the grasp points and the centers to reach (n, 3)."""
        return state.grasp, state.goal

    def evaluate_goals(self, achieved: Array, desired: Array, collided: Bools) -> Outcome:
        """Return the outcome for grasp points and centers (n, 3)."""
        distance = lengths(desired - achieved)
        return Outcome(distance, success=is_reached(distance, self.success_radius) & ~collided, failure=collided)
