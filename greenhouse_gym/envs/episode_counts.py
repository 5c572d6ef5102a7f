"""Counts, contacts and names of the current episodes, which their infos report."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.actions import Command
from greenhouse_gym.envs.contacts import NAME_SEPARATOR, NO_CONTACT, Contact, Contacts
from greenhouse_gym.envs.episodes import Episode
from greenhouse_gym.envs.state import State
from greenhouse_gym.scene.mjcf import TIMESTEP


class EpisodeCounts:
    """Counts, contacts and names of the current episodes of n simulations, in arrays of length n.

    Args:
        count: Number of simulations n.

    Attributes:
        steps: Actions so far.
        index: Current target as an index into the targets of the episode.
        target: Current target as an index into the tomatoes of the scene.
    """

    def __init__(self, count: int):
        self.steps, self.index, self.target = (np.zeros(count, dtype=np.int64) for _ in range(3))
        self._speed_limited, self._position_limited = (np.zeros(count, dtype=np.int64) for _ in range(2))
        self._brushed_steps, self._brushing = (np.zeros(count, dtype=np.int64) for _ in range(2))
        self._scene, self._difficulty, self._contact = (np.full(count, "", dtype=object) for _ in range(3))
        self._self_collision = np.zeros(count, dtype=np.bool_)

    def begin(self, i: int, episode: Episode) -> None:
        """Begin the episode of a simulation."""
        for counts in (
            self.steps, self.index, self._speed_limited, self._position_limited, self._brushed_steps, self._brushing
        ):  # fmt: skip
            counts[i] = 0
        self.target[i] = episode.targets[0]
        self._scene[i], self._difficulty[i] = episode.scene.name, episode.difficulty
        self._record(i, NO_CONTACT)

    def add_step(self, command: Command, contacts: Contacts) -> None:
        """Count an action of all simulations."""
        self.record(contacts)
        self.steps += 1
        self._speed_limited += command.speed_limited
        self._position_limited += command.position_limited
        self._brushed_steps += contacts.leaf_steps
        self._brushing[:] = contacts.leaf_steps

    def record(self, contacts: Contacts) -> None:
        """Keep the names of contacts that ended an episode."""
        for i, contact in contacts.first.items():
            self._record(i, contact)

    def _record(self, i: int, contact: Contact) -> None:
        self._contact[i], self._self_collision[i] = NAME_SEPARATOR.join(contact.names), contact.self_collision

    def info(self, state: State) -> dict[str, npt.NDArray[Any]]:
        """Return the info that every task has, as live arrays."""
        return {
            "is_success": state.success,
            "collision": state.collided,
            "contact": self._contact,
            "self_collision": self._self_collision,
            "contacts": state.contacts,
            "distance": state.distance,
            "clearance": state.clearance.min(axis=1).astype(np.float64),
            "scene": self._scene,
            "target": self.target,
            "difficulty": self._difficulty,
            "steps": self.steps,
            "speed_limited": self._speed_limited,
            "position_limited": self._position_limited,
        }

    def brush_info(self) -> dict[str, npt.NDArray[Any]]:
        """Return the seconds in which a leaf was touched: in the last step, and in the episode so far."""
        return {"brushing": TIMESTEP * self._brushing, "brushed_time": TIMESTEP * self._brushed_steps}
