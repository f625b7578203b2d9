"""Actions as the last text ids of a vocabulary, of OpenVLA and of what was made like it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ActionTokens:
    """The last `bins` text ids, from the highest down, which name bins of [-1, 1].

    Attributes:
        vocabulary: Number of text ids, without the padding of the embedding.
        bins: Number of these ids, and of the edges between which the bins lie.
    """

    vocabulary: int
    bins: int

    @property
    def centres(self) -> NDArray[np.float64]:
        """The middles of the bins, (bins - 1,): `bins` edges have one interval fewer between them."""
        edges = np.linspace(-1, 1, self.bins)
        return np.asarray((edges[:-1] + edges[1:]) / 2)

    def values(self, ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return normalised values of ids of any shape; an id outside the range counts as the nearest bin."""
        return np.asarray(self.centres[np.clip(self.vocabulary - 1 - ids, 0, self.bins - 2)])

    def is_action(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return per id True where it names a bin."""
        return np.asarray((ids >= self.vocabulary - self.bins) & (ids < self.vocabulary))
