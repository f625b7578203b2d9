"""The statistics that give normalised actions the units of a data set."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CheckpointError
from probe_kit.hashing import sha256_json
from probe_kit.models.bounds import check_bounds
from probe_kit.models.checkpoint_files import chosen_name

DIMENSIONS = 7
"""The count of numbers of an action: an end-effector's delta, and the gripper last."""
GRIPPER_OPEN = 0.5
"""The threshold of the gripper: the data sets have 1 for an open gripper and 0 for a closed one."""


@dataclass(frozen=True)
class ActionStatistics:
    """The 1 % and 99 % quantiles of a data set, per dimension.

    Attributes:
        key: Name of the data set.
        low: (D,), the 1 % quantiles, which stand for -1.
        high: (D,), the 99 % quantiles, which stand for 1.
        mask: (D,), False for dimensions that stay as the model puts them out, such as a gripper that is 0 or 1 in
            the data.
    """

    lacking: ClassVar[str] = (
        "the checkpoint has no norm_stats in its config.json and no dataset_statistics.json: its actions have no "
        "physical unit. Take the statistics of the data set it was trained on"
    )
    """The message for a checkpoint without statistics."""

    key: str
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    mask: NDArray[np.bool_]

    @classmethod
    def choose(cls, statistics: Mapping[str, Any], key: str | None, source: str = "the checkpoint") -> Self:
        """Return the statistics of data set `key`; without one, of the only data set.

        Args:
            statistics: The statistics of every data set, by its name.
            key: Name of the data set; None for the only one.
            source: The file that holds them, for messages.

        Raises:
            UsageError: For a key that is not there or has to be chosen.
            CheckpointError: For bad statistics.
        """
        if not statistics:
            raise CheckpointError(cls.lacking)
        name = chosen_name(statistics, key, "unnorm_key", source)
        return cls.of(name, statistics[name].get("action") or {})

    @classmethod
    def of(cls, key: str, action: Mapping[str, Any]) -> Self:
        """Read q01, q99 and, if there is one, mask.

        Raises:
            CheckpointError: If they are missing or do not fit each other.
        """
        if missing := [name for name in ("q01", "q99") if name not in action]:
            raise CheckpointError(f"the action statistics of {key} lack {' and '.join(missing)}")
        low, high = np.asarray(action["q01"], np.float64), np.asarray(action["q99"], np.float64)
        mask = np.asarray(action.get("mask", np.ones(low.shape, bool)), bool)
        if not low.shape == high.shape == mask.shape or not np.isfinite([low, high]).all():
            raise CheckpointError(f"the action statistics of {key} are not one finite number per dimension")
        # Of numbers that are scaled: a gripper that stays as it is may have equal bounds.
        check_bounds(low[mask], high[mask], f"the action statistics of {key}")
        return cls(key, low, high, mask)

    @property
    def sha256(self) -> str:
        """The hash of the numbers."""
        return sha256_json([self.low.tolist(), self.high.tolist(), self.mask.tolist()])

    def restore(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return normalised values (…, D) in the data set's units."""
        return np.where(self.mask, (values + 1) / 2 * (self.high - self.low) + self.low, values)


def open_or_closed(actions: NDArray[Any]) -> NDArray[np.float32]:
    """Return actions (…, D) as float32 with the gripper, the last number, open (1) or closed (0)."""
    decided = actions.copy()
    decided[..., -1] = decided[..., -1] > GRIPPER_OPEN
    return decided.astype(np.float32)
