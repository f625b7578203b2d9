"""OpenVLA's actions: token ids to bins."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ActionTokens:
    """The last `bins` text ids, from the highest down, name bins of [-1, 1].

    vocabulary: number of text ids, without the padding of the embedding.
    """

    vocabulary: int
    bins: int

    @property
    def centres(self) -> NDArray[np.float64]:
        """(bins - 1,): `bins` edges have one interval fewer between them."""
        edges = np.linspace(-1, 1, self.bins)
        return np.asarray((edges[:-1] + edges[1:]) / 2)

    def values(self, ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Normalised values of ids of any shape; an id outside the range counts as the nearest bin."""
        return np.asarray(self.centres[np.clip(self.vocabulary - 1 - ids, 0, self.bins - 2)])

    def is_action(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return, per id, True where it names a bin."""
        return np.asarray((ids >= self.vocabulary - self.bins) & (ids < self.vocabulary))
