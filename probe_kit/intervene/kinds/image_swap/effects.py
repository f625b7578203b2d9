"""What image swaps did, per category. Reads stored outcomes; needs no model."""

from dataclasses import asdict, dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.interventions import Readout
from probe_kit.intervene.kinds.base import Measurement
from probe_kit.intervene.kinds.reach import REACHED, TILES_APART, Reach, tiles_apart
from probe_kit.intervene.store.answers import CLEAN, IMAGE_SWAP, ConditionOutcomes
from probe_kit.intervene.store.selection import preferred_by_category
from probe_kit.intervene.store.settings import FIRST_CHUNK
from probe_kit.statistics.bootstrap import GAINS, group_bootstrap, units_seed
from probe_kit.statistics.paired_signs import paired_greater_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.student import unbounded_student_interval
from probe_kit.train.data.run_reader import RunReader, seed_text_of

NAME = "image-swap"
FOLLOWS, REVERSES = 1, -1
SMALLEST_EFFECT_OF_INTEREST = 0.25
"""Net follow rate below which a category is not acted on; of the closed loop and the erasure too."""


@dataclass(frozen=True)
class ImageSwapEffect:
    """What the swap did to the actions, in one category.

    follow_rate: share of episodes in which the action goes to the correct picture, and to the other side once the
    two are swapped; reversal_rate: in which it does the reverse. net_follow_rate: their
    difference, with its 95 % interval by groups. follow_p, reversal_p: exact, one-sided: an item's action moves
    toward (away from) the correct picture more often than by chance; the larger of by items and by groups.
    median_displacement: metres between the two actions. reach, reach_source: see `Reach`. reach_share: mean
    displacement toward the correct picture in units of the reach, 1 for a whole change of sides, with Student's
    95 % interval by groups. moved_share: the same whichever way the action moves. left_reached, right_reached: of
    the episodes with the correct picture on that side, the share that reaches it (beyond a quarter of the reach
    from the middle), minus that share with swapped images. readout: `first-chunk` or `per-step`, of all
    displacements. key: of the stored intervention.
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
    reach: float
    reach_source: str
    reach_share: float
    reach_share_ci: tuple[float, float]
    moved_share: float
    left_reached: float
    right_reached: float
    readout: str = FIRST_CHUNK
    key: str = ""

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def measured_image_swap(measurement: Measurement) -> list[ImageSwapEffect]:
    """The effects of a stored image swap."""
    return image_swap_effects(
        measurement.outcomes, measurement.seed_text, measurement.key, measurement.readout, measurement.tiles_apart
    )


def image_swap_effects(
    outcomes: ConditionOutcomes,
    seed_text: str,
    key: str = "",
    readout: str = FIRST_CHUNK,
    tiles_apart: float = TILES_APART,
) -> list[ImageSwapEffect]:
    """One per category, in the order of the episodes.

    seed_text: of the run, by which intervals are drawn. readout: of the intervention. tiles_apart: metres, for
    policies without a reach of their own.
    """
    reach = Reach.of(outcomes.of(CLEAN), tiles_apart)
    return [
        ImageSwapEffect(**swap_columns(own, category, IMAGE_SWAP, seed_text, reach), readout=readout, key=key)
        for category, own in outcomes.by_category()
    ]


def swap_columns(
    outcomes: ConditionOutcomes, category: str, swapped: str, seed_text: str, reach: Reach
) -> dict[str, Any]:
    """The columns of `ImageSwapEffect` of one category. swapped: compared with the clean condition."""
    clean, other = (outcomes.correct_sign * outcomes.of(name) for name in (CLEAN, swapped))
    responses = swap_responses(outcomes, swapped)
    net = responses.astype(float)
    displacement = clean - other
    shares = displacement / reach.metres
    follow_p, reversal_p = swap_p_values(outcomes, swapped)
    return {
        "category": category,
        "n_episodes": net.size,
        "n_items": np.unique(outcomes.items).size,
        "n_groups": np.unique(outcomes.groups).size,
        "follow_rate": float((responses == FOLLOWS).mean()),
        "reversal_rate": float((responses == REVERSES).mean()),
        "net_follow_rate": float(net.mean()),
        "net_follow_rate_ci": net_interval(net, outcomes, seed_text),
        "follow_p": follow_p,
        "reversal_p": reversal_p,
        "median_displacement": float(np.median(np.abs(displacement))),
        "reach": reach.metres,
        "reach_source": reach.source,
        "reach_share": float(shares.mean()),
        "reach_share_ci": unbounded_student_interval(shares, outcomes.groups),
        "moved_share": float(np.abs(shares).mean()),
        **{f"{side}_reached": _reached(outcomes.sides == side, clean, other, reach) for side in ("left", "right")},
    }


def swap_responses(outcomes: ConditionOutcomes, swapped: str = IMAGE_SWAP) -> NDArray[np.int8]:
    """(E,) `FOLLOWS` for actions to the correct picture in both layouts, `REVERSES` to the wrong one, or 0."""
    clean, other = (np.sign(outcomes.correct_sign * outcomes.of(name)) for name in (CLEAN, swapped))
    return np.asarray(np.where(clean * other < 0, clean, 0), np.int8)


def swap_responses_by_episode(run: RunReader) -> dict[str, int]:
    """By episode id, how its action responds in the image swap that tables read; empty without a stored one.

    Raises RunDamagedError.
    """
    stored = [result.outcomes for result in preferred_by_category(run, NAME).values()]
    return {
        str(name): int(response)
        for outcomes in stored
        for name, response in zip(outcomes.episodes, swap_responses(outcomes), strict=True)
    }


def swap_p_values(outcomes: ConditionOutcomes, swapped: str = IMAGE_SWAP) -> tuple[float, float]:
    """Whether actions move toward the correct picture, and whether away from it; of one category."""
    displacement = outcomes.correct_sign * (outcomes.of(CLEAN) - outcomes.of(swapped))
    toward, away = (paired_greater_p(sign * displacement, outcomes.items, outcomes.groups) for sign in (1.0, -1.0))
    return toward, away


def swap_sign(outcomes: ConditionOutcomes) -> float:
    """1, or −1 in a category in which swapped images lead actions away from the correct picture, beyond chance.

    What carries the effect of the swap moves actions where the swap does: p of patches are of that direction.
    """
    is_reversed = IMAGE_SWAP in outcomes.conditions and swap_p_values(outcomes)[1] < SIGNIFICANCE
    return -1.0 if is_reversed else 1.0


def _reached(
    there: NDArray[np.bool_], clean: NDArray[np.float64], other: NDArray[np.float64], reach: Reach
) -> float:
    """By how much more often the side of the correct picture is reached; 0 where it never lies there."""
    if not there.any():
        return 0.0
    near, far = (values[there] > REACHED * reach.metres for values in (clean, other))
    return float(near.mean() - far.mean())


def net_interval(net: NDArray[np.float64], outcomes: ConditionOutcomes, seed_text: str) -> tuple[float, float]:
    """95 % interval by groups of the mean over episodes of (E,) gains."""
    drawn = units_seed(outcomes.groups, seed_text)
    low, high = group_bootstrap(net[:, None], outcomes.groups, drawn, bounds=GAINS)
    return float(low[0]), float(high[0])


def stored_image_swaps(run: RunReader, readout: str | None = None) -> dict[str, ImageSwapEffect]:
    """By category, what the image swaps did that are stored for the episodes the run has now.

    readout: of those alone; None for any. Of several the preferred one, see `store.selection`; empty if there is
    none. Raises RunDamagedError if any stored intervention was changed.
    """
    preferred = preferred_by_category(run, NAME, readout)
    apart, rows = tiles_apart(run), dict[str, dict[str, ImageSwapEffect]]()
    for stored in {result.stored.key: result.stored for result in preferred.values()}.values():
        own = str(stored.settings.get("readout", FIRST_CHUNK))
        found = image_swap_effects(stored.outcomes(), seed_text_of(run), stored.key, own, apart)
        rows[stored.key] = {row.category: row for row in found}
    return {category: rows[result.stored.key][category] for category, result in preferred.items()}


def image_swaps_in_use(run: RunReader) -> set[str]:
    """Keys of the stored image swaps that verdicts and tables read, of either readout. Raises RunDamagedError."""
    return {row.key for readout in get_args(Readout) for row in stored_image_swaps(run, readout).values()}
