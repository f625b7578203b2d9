"""What the exchange of the two pictures did, per category. Reads stored answers; needs no model."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.intervene.store.answers import CLEAN, IMAGE_SWAP, ConditionOutcomes
from probe_kit.intervene.store.selection import preferred_by_category
from probe_kit.statistics.bootstrap import GAINS, group_bootstrap, units_seed
from probe_kit.statistics.paired_signs import paired_greater_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.data.run_reader import RunReader

SMALLEST_EFFECT_OF_INTEREST = 0.25
"""Share of episodes by which following must outweigh going against, to be called following."""


@dataclass(frozen=True)
class ImageSwapEffect:
    """Whether the action follows the pictures, in one category.

    follows: share of episodes in which the action goes to the correct picture, and to the other side once the two
    are exchanged; against: in which it does the reverse. net: follows − against, with its 95 % interval by groups.
    p_follows, p_against: exact, one-sided: an item's action moves toward (away from) the correct picture more
    often than a coin would have it; the larger of by items and by groups. median_displacement: median metres between the two
    actions. key: of the stored intervention.
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

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def image_swap_effects(outcomes: ConditionOutcomes, suite: str, key: str = "") -> list[ImageSwapEffect]:
    """One per category, in the order of the episodes. suite: its identity, of which intervals are drawn."""
    return [_of_category(own, category, suite, key) for category, own in outcomes.by_category()]


def _of_category(outcomes: ConditionOutcomes, category: str, suite: str, key: str) -> ImageSwapEffect:
    plain, exchanged = (outcomes.correct_sign * outcomes.of(name) for name in (CLEAN, IMAGE_SWAP))
    follows, against = (plain > 0) & (exchanged < 0), (plain < 0) & (exchanged > 0)
    net = follows.astype(float) - against
    median_displacement = plain - exchanged
    return ImageSwapEffect(
        category=category,
        n_episodes=net.size,
        n_items=np.unique(outcomes.items).size,
        n_groups=np.unique(outcomes.groups).size,
        follow_rate=float(follows.mean()),
        reversal_rate=float(against.mean()),
        net_follow_rate=float(net.mean()),
        net_follow_rate_ci=net_interval(net, outcomes, suite),
        follow_p=paired_greater_p(median_displacement, outcomes.items, outcomes.groups),
        reversal_p=paired_greater_p(-median_displacement, outcomes.items, outcomes.groups),
        median_displacement=float(np.median(np.abs(median_displacement))),
        key=key,
    )


def net_interval(net: NDArray[np.float64], outcomes: ConditionOutcomes, suite: str) -> tuple[float, float]:
    """95 % interval by groups of the mean over episodes of (E,) gains."""
    drawn = units_seed(outcomes.groups, suite)
    low, high = group_bootstrap(net[:, None], outcomes.groups, drawn, bounds=GAINS)
    return float(low[0]), float(high[0])


def stored_image_swaps(run: RunReader) -> dict[str, ImageSwapEffect]:
    """By category, what the exchange of pictures did, of those that are stored for the episodes the run has now.

    Of several the one that says most, see `standing`; empty if there is none. Raises RunDamagedError if any stored
    intervention was changed.
    """
    return {
        category: row
        for category, result in preferred_by_category(run, "follow").items()
        for row in image_swap_effects(result.outcomes, run.suite, result.stored.key)
    }
