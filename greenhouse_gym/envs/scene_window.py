"""Sliding window over the scenes of a large bank, from which episodes are drawn.

Reading and compiling a scene and computing its distance field take as long as hundreds of steps. Therefore episodes are
drawn from a few scenes at a time, which stay in memory. They are replaced one by one in an order that the seed
shuffles, until every scene had its turn and the next round begins.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

LARGEST_WHOLE = 300
"""Maximum number of scenes of a split without a window."""

WINDOW = 24
"""Number of scenes in the window."""

DRAWS_PER_SCENE = 256
"""Number of draws after which the next scene enters the window; each scene is drawn about as often."""


class SceneWindow:
    """Draws names of scenes from a window that advances with the draws; deterministic for a seed.

    Args:
        names: Names of all scenes.
    """

    def __init__(self, names: Sequence[str]):
        self._names = names
        self._order: np.ndarray[tuple[int], np.dtype[np.int64]] | None = None
        self._draws = 0

    @property
    def whole(self) -> bool:
        """True if the split is small enough to be drawn from as a whole."""
        return len(self._names) <= LARGEST_WHOLE

    def restart(self, seed: int) -> None:
        """Begin a new round in the order given by a seed."""
        if not self.whole:
            self._order, self._draws = np.random.default_rng(seed).permutation(len(self._names)), 0

    def draw(self, rng: np.random.Generator) -> str:
        """Draw the name of a scene, uniformly within the window."""
        if self.whole:
            return self._names[int(rng.integers(len(self._names)))]
        if self._order is None:
            self.restart(int(rng.integers(2**32)))
        assert self._order is not None
        first = self._draws // DRAWS_PER_SCENE
        position = int(rng.integers(first, first + WINDOW))
        self._draws += 1
        return self._names[int(self._order[position % len(self._order)])]
