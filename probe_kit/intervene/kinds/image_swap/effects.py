"""What the exchange of the two pictures did, per category. Reads stored answers; needs no model."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.intervene.store.answers import EXCHANGED, PLAIN, Answers
from probe_kit.intervene.store.selection import foremost
from probe_kit.statistics.bootstrap import GAINS, group_bootstrap, units_seed
from probe_kit.statistics.paired_signs import paired_greater_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.data.run_reader import RunReader

WORTH = 0.25
"""Share of episodes by which following must outweigh going against, to be called following."""


@dataclass(frozen=True)
class Following:
    """Whether the action follows the pictures, in one category.

    follows: share of episodes in which the action goes to the correct picture, and to the other side once the two
    are exchanged; against: in which it does the reverse. net: follows − against, with its 95 % interval by groups.
    p_follows, p_against: exact, one-sided: an item's action moves toward (away from) the correct picture more
    often than a coin would have it; the larger of by items and by groups. shift: median metres between the two
    actions. key: of the stored intervention.
    """

    category: str
    n_episodes: int
    n_items: int
    n_groups: int
    follows: float
    against: float
    net: float
    net_ci: tuple[float, float]
    p_follows: float
    p_against: float
    shift: float
    key: str = ""

    @property
    def is_following(self) -> bool:
        """Beyond chance, and in enough episodes to matter."""
        return self.p_follows < SIGNIFICANCE and self.net >= WORTH

    @property
    def is_against(self) -> bool:
        """The mirror of it."""
        return self.p_against < SIGNIFICANCE and self.net <= -WORTH

    @property
    def is_bounded(self) -> bool:
        """Whether the interval leaves no room for following that matters."""
        return self.net_ci[1] < WORTH

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def following(answers: Answers, suite: str, key: str = "") -> list[Following]:
    """One per category, in the order of the episodes. suite: its identity, of which intervals are drawn."""
    return [_of_category(own, category, suite, key) for category, own in answers.by_category()]


def _of_category(answers: Answers, category: str, suite: str, key: str) -> Following:
    plain, exchanged = (answers.toward * answers.of(name) for name in (PLAIN, EXCHANGED))
    follows, against = (plain > 0) & (exchanged < 0), (plain < 0) & (exchanged > 0)
    net = follows.astype(float) - against
    shift = plain - exchanged
    return Following(
        category=category,
        n_episodes=net.size,
        n_items=np.unique(answers.items).size,
        n_groups=np.unique(answers.groups).size,
        follows=float(follows.mean()),
        against=float(against.mean()),
        net=float(net.mean()),
        net_ci=net_interval(net, answers, suite),
        p_follows=paired_greater_p(shift, answers.items, answers.groups),
        p_against=paired_greater_p(-shift, answers.items, answers.groups),
        shift=float(np.median(np.abs(shift))),
        key=key,
    )


def net_interval(net: NDArray[np.float64], answers: Answers, suite: str) -> tuple[float, float]:
    """95 % interval by groups of the mean over episodes of (E,) gains."""
    drawn = units_seed(answers.groups, suite)
    low, high = group_bootstrap(net[:, None], answers.groups, drawn, bounds=GAINS)
    return float(low[0]), float(high[0])


def stored_following(run: RunReader) -> dict[str, Following]:
    """By category, what the exchange of pictures did, of those that are stored for the episodes the run has now.

    Of several the one that says most, see `standing`; empty if there is none. Raises RunDamagedError if any stored
    intervention was changed.
    """
    return {
        category: row
        for category, told in foremost(run, "follow").items()
        for row in following(told.answers, run.suite, told.stored.key)
    }
