"""OpenVLA's actions: token ids to bins, bins to the units of a data set."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CheckpointError
from probe_kit.hashing import sha256_json
from probe_kit.models.bounds import check_bounds
from probe_kit.models.statistics_choice import chosen_name


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


@dataclass(frozen=True)
class ActionStatistics:
    """The statistics that give values a data set's units: per dimension its 1 % and 99 % quantiles.

    mask: False for dimensions that stay as decoded, such as a gripper that is 0 or 1 in the data.
    sha256: of the numbers.
    """

    key: str
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    mask: NDArray[np.bool_]
    sha256: str

    @classmethod
    def choose(
        cls, statistics: Mapping[str, Any], key: str | None, source: str = "the checkpoint"
    ) -> "ActionStatistics":
        """The statistics of data set `key`; without one, of the only data set. source: the file that holds them.

        Raises UsageError for a key that is not there or has to be chosen, CheckpointError for bad statistics.
        """
        if not statistics:
            raise CheckpointError(
                "the checkpoint has no norm_stats in its config.json and no dataset_statistics.json: its actions "
                "have no physical unit. Take the statistics of the data set it was trained on"
            )
        name = chosen_name(statistics, key, "unnorm_key", source)
        return cls._read(name, statistics[name])

    @classmethod
    def _read(cls, key: str, entry: Mapping[str, Any]) -> "ActionStatistics":
        action = entry.get("action", {})
        missing = [name for name in ("q01", "q99") if name not in action]
        if missing:
            raise CheckpointError(f"the action statistics of {key} lack {' and '.join(missing)}")
        low, high = np.asarray(action["q01"], np.float64), np.asarray(action["q99"], np.float64)
        mask = np.asarray(action.get("mask", np.ones(low.shape, bool)), bool)
        if not low.shape == high.shape == mask.shape or not np.isfinite([low, high]).all():
            raise CheckpointError(f"the action statistics of {key} are not one finite number per dimension")
        check_bounds(low[mask], high[mask], f"the action statistics of {key}")
        return cls(key, low, high, mask, sha256_json([low.tolist(), high.tolist(), mask.tolist()]))

    def restore(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """(…, D) normalised values in the data set's units."""
        return np.where(self.mask, (values + 1) / 2 * (self.high - self.low) + self.low, values)
