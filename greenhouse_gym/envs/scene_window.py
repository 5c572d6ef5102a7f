"""Which scenes of a large bank episodes are drawn from at present.

A scene must be read, compiled and measured out before an arm can move in it, which takes as long as hundreds of steps.
So only some scenes are drawn from at a time, those that stay ready in memory, and one after the other is exchanged for
the next in an order that the seed shuffles, until every scene has had its turn and the round begins again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

LARGEST_WHOLE = 300
"""A split with no more scenes than this is drawn from as a whole."""

WINDOW = 24
"""How many scenes of a larger split are drawn from at a time."""

DRAWS_PER_SCENE = 256
"""After so many draws the next scene comes into the window; each is drawn about as often before it leaves."""


class SceneWindow:
    """Draws names of scenes from a window that moves on with the draws; the same seed and draws give the same names.

    Args:
        names: Names of all scenes.
    """

    def __init__(self, names: Sequence[str]):
        self._names = names
        self._order: np.ndarray[tuple[int], np.dtype[np.int64]] | None = None
        self._draws = 0

    @property
    def whole(self) -> bool:
        """Whether all scenes are drawn from at all times."""
        return len(self._names) <= LARGEST_WHOLE

    def restart(self, seed: int) -> None:
        """Begin a new round in the order of a seed."""
        if not self.whole:
            self._order, self._draws = np.random.default_rng(seed).permutation(len(self._names)), 0

    def draw(self, rng: np.random.Generator) -> str:
        """The name of a scene, each of those in the window as likely as the others."""
        if self.whole:
            return self._names[int(rng.integers(len(self._names)))]
        if self._order is None:
            self.restart(int(rng.integers(2**32)))
        assert self._order is not None
        gone = self._draws // DRAWS_PER_SCENE
        place = int(rng.integers(gone, gone + WINDOW))
        self._draws += 1
        return self._names[int(self._order[place % len(self._order)])]
