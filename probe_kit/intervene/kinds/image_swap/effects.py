"""What image swaps did, per category. Reads stored outcomes; needs no model."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.intervene.kinds.base import Measurement
from probe_kit.intervene.store.answers import CLEAN, IMAGE_SWAP, ConditionOutcomes
from probe_kit.intervene.store.selection import preferred_by_category
from probe_kit.statistics.bootstrap import GAINS, group_bootstrap, units_seed
from probe_kit.statistics.paired_signs import paired_greater_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.data.run_reader import RunReader

NAME = "image-swap"
SMALLEST_EFFECT_OF_INTEREST = 0.25
"""Net follow rate from which the action is said to follow."""

Response = Literal["follows", "reverses", "does not follow", "open"]
"""What the action does when the pictures are swapped; `open` where its interval leaves room for following."""


@dataclass(frozen=True)
class ImageSwapEffect:
    """Whether the action follows the pictures, in one category.

    follow_rate: share of episodes in which the action goes to the correct picture, and to the other side once the
    two are swapped; reversal_rate: in which it does the reverse. net_follow_rate: their
    difference, with its 95 % interval by groups. follow_p, reversal_p: exact, one-sided: an item's action moves
    toward (away from) the correct picture more often than by chance; the larger of by items and by groups.
    median_displacement: metres between the two actions. key: of the stored intervention.
    """

    category: str
    n_episodes: int
    n_items: int
    n_groups: int
    follow_rate: float
    reversal_rate: float
    net_follow_rate: float
    net_follow_rate_ci: tuple[float, float]
    follow_p: float
    reversal_p: float
    median_displacement: float
    key: str = ""

    @property
    def follows_images(self) -> bool:
        """Beyond chance, and in enough episodes to matter."""
        return self.follow_p < SIGNIFICANCE and self.net_follow_rate >= SMALLEST_EFFECT_OF_INTEREST

    @property
    def is_against(self) -> bool:
        """The mirror of it."""
        return self.reversal_p < SIGNIFICANCE and self.net_follow_rate <= -SMALLEST_EFFECT_OF_INTEREST

    @property
    def is_bounded(self) -> bool:
        """Whether the interval leaves no room for following that matters."""
        return self.net_follow_rate_ci[1] < SMALLEST_EFFECT_OF_INTEREST

    @property
    def response(self) -> Response:
        """The same three in a word."""
        if self.follows_images:
            return "follows"
        if self.is_against:
            return "reverses"
        return "does not follow" if self.is_bounded else "open"

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def measured_image_swap(measurement: Measurement) -> list[ImageSwapEffect]:
    """The effects of a stored image swap."""
    return image_swap_effects(measurement.outcomes, measurement.suite, measurement.key)


def image_swap_effects(outcomes: ConditionOutcomes, suite: str, key: str = "") -> list[ImageSwapEffect]:
    """One per category, in the order of the episodes. suite: its identity, of which intervals are drawn."""
    return [
        ImageSwapEffect(**swap_columns(own, category, IMAGE_SWAP, suite), key=key)
        for category, own in outcomes.by_category()
    ]


def swap_columns(outcomes: ConditionOutcomes, category: str, swapped: str, suite: str) -> dict[str, Any]:
    """The columns of `ImageSwapEffect` of one category. swapped: compared with the clean condition."""
    clean, other = (outcomes.correct_sign * outcomes.of(name) for name in (CLEAN, swapped))
    follows, reverses = (clean > 0) & (other < 0), (clean < 0) & (other > 0)
    net = follows.astype(float) - reverses
    displacement = clean - other
    return {
        "category": category,
        "n_episodes": net.size,
        "n_items": np.unique(outcomes.items).size,
        "n_groups": np.unique(outcomes.groups).size,
        "follow_rate": float(follows.mean()),
        "reversal_rate": float(reverses.mean()),
        "net_follow_rate": float(net.mean()),
        "net_follow_rate_ci": net_interval(net, outcomes, suite),
        "follow_p": paired_greater_p(displacement, outcomes.items, outcomes.groups),
        "reversal_p": paired_greater_p(-displacement, outcomes.items, outcomes.groups),
        "median_displacement": float(np.median(np.abs(displacement))),
    }


def net_interval(net: NDArray[np.float64], outcomes: ConditionOutcomes, suite: str) -> tuple[float, float]:
    """95 % interval by groups of the mean over episodes of (E,) gains."""
    drawn = units_seed(outcomes.groups, suite)
    low, high = group_bootstrap(net[:, None], outcomes.groups, drawn, bounds=GAINS)
    return float(low[0]), float(high[0])


def stored_image_swaps(run: RunReader) -> dict[str, ImageSwapEffect]:
    """By category, what the image swaps did that are stored for the episodes the run has now.

    Of several the preferred one, see `store.selection`; empty if there is none. Raises RunDamagedError if any
    stored intervention was changed.
    """
    return {
        category: row
        for category, result in preferred_by_category(run, NAME).items()
        for row in image_swap_effects(result.outcomes, run.suite, result.stored.key)
    }


def image_swaps_in_use(run: RunReader) -> set[str]:
    """Keys of the stored image swaps that verdicts and tables read. Raises RunDamagedError."""
    return {row.key for row in stored_image_swaps(run).values()}
