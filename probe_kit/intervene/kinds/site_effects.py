"""What edits of sites did to first actions, place by place. Reads stored outcomes; needs no model.

Effects are signed: the *target side* is the one on which the correct picture lies once the two are swapped (an
interchange), or the side that is steered to. A flip rate alone says nothing: actions flip away from it as well.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.edits.sites import RESIDUAL, PlaceName
from probe_kit.intervene.kinds.base import (
    ConditionName,
    EffectRow,
    Measurement,
    Values,
    common_columns,
    test_against_controls,
)
from probe_kit.intervene.kinds.image_swap.effects import net_interval, swap_sign
from probe_kit.intervene.kinds.reach import SMALLEST_REACH
from probe_kit.intervene.kinds.swap_shares import share_of_swap
from probe_kit.intervene.store.answers import CLEAN, IMAGE_SWAP, UNCHANGED, ConditionOutcomes
from probe_kit.statistics.significance import SIGNIFICANCE

LOCALISATION_SHARE = 0.5
"""Share of the whole image swap's effect from which a place is called localised."""
LARGE_CHANGE = 2.0
"""Token norms beyond which a steering is said to be large."""


@dataclass(frozen=True, kw_only=True)
class PatchEffect(EffectRow):
    """What an edit at one place did, in one category; see `EffectRow`.

    net: share of episodes whose action flips to the target side, minus those that flip away from it; net_left,
    net_right: the same by target side. coefficient: of steering, else empty. effect: share of what the whole image
    swap does to where the action goes, toward the target side, with its 95 % interval by groups; None if the swap
    does nothing, so that a share would be a ratio of noise. mean_displacement, control_displacement: metres toward
    the target side, of the edit and of its matched controls. t, p, p_fwe: of the displacement beyond the
    controls', one-sided, by sign flips of whole groups, of an interchange in the direction of the swap itself;
    p_fwe against the largest t of all edits of the category.
    """

    coefficient: str
    effect: float | None
    effect_ci: tuple[float, float] | None
    net_left: float
    net_right: float
    mean_displacement: float
    control_displacement: float | None
    t: float
    p: float | None
    p_fwe: float | None

    @property
    def is_localised(self) -> bool:
        """Whether it carries half of the effect, beyond chance among all that was tried."""
        enough = self.effect is not None and self.effect >= LOCALISATION_SHARE
        return enough and self.p_fwe is not None and self.p_fwe < SIGNIFICANCE

    @property
    def moves_action(self) -> bool:
        """Whether it moves the action to the target side beyond chance, and by the smallest reach of a policy."""
        beyond = self.p_fwe is not None and self.p_fwe < SIGNIFICANCE
        return beyond and self.mean_displacement >= SMALLEST_REACH

    @property
    def is_dose(self) -> bool:
        """Whether it is a steering by more than nothing."""
        return self.coefficient not in ("", "0")

    @property
    def is_by_construction(self) -> bool:
        """Whether its place carries the effect in every policy that acts on the images, and so locates nothing.

        The first layer of the backbone holds the swapped images themselves, and the acting stream the action.
        """
        place = PlaceName.parse(self.place)
        is_first = place.stream == "backbone" and place.layer == 0 and place.quantity in ("", RESIDUAL)
        return place.stream not in ("backbone", KV_STREAM) or is_first

    @property
    def name(self) -> str:
        """What was edited, in a few words."""
        return " ".join(filter(None, (super().name, self.coefficient and f"coefficient {self.coefficient}")))


def measured_patches(measurement: Measurement) -> list[PatchEffect]:
    """The effects of an interchange or a steering."""
    target_side = str(measurement.settings.get("target_side", IMAGE_SWAP))
    return patch_effects(measurement.outcomes, measurement.seed_text, target_side, measurement.key)


def patch_effects(
    outcomes: ConditionOutcomes, seed_text: str, target_side: str = IMAGE_SWAP, key: str = ""
) -> list[PatchEffect]:
    """One per category and edit. target_side: `image_swap`, or the side that is steered to, see `Steering`."""
    return [
        row
        for category, own in outcomes.by_category()
        for row in _of_category(own, category, seed_text, target_side, key)
    ]


def steering_notes(rows: Sequence[PatchEffect], _: Measurement) -> list[str]:
    """Return what a reader of steering must know: too large a change, and a vector that cannot move the answer."""
    steered = {row.name: row.relative_change for row in rows if row.coefficient}
    large = [
        f"{name} moves tokens by {ratio:.1f} times their own norm; what that does is little evidence."
        for name, ratio in steered.items()
        if ratio > LARGE_CHANGE
    ]
    return large + [
        f"{category}: one vector that is added to every token moves no action. An answer that lies in which "
        "tokens are marked has no such vector; --direction mean-difference:1 has a vector for each position."
        for category in _unmoved_by_one_vector(rows)
    ]


def _unmoved_by_one_vector(rows: Sequence[PatchEffect]) -> list[str]:
    """Categories in which steering along a direction of the tokens' mean moves no action by a smallest reach."""
    edits = [row for row in rows if row.is_dose and not row.is_control]
    pooled = [row for row in edits if ":" not in row.direction]
    moved = {row.category for row in pooled if abs(row.mean_displacement) >= SMALLEST_REACH}
    return [name for name in dict.fromkeys(row.category for row in pooled) if name not in moved]


def target_sign(outcomes: ConditionOutcomes, target_side: str) -> NDArray[np.float64]:
    """(E,) the side that is pushed to, +1 for left."""
    fixed = {"left": 1.0, "right": -1.0}
    if target_side in fixed:
        return np.full(outcomes.correct_sign.size, fixed[target_side])
    return outcomes.correct_sign if target_side == "correct" else -outcomes.correct_sign


def _of_category(
    outcomes: ConditionOutcomes, category: str, seed_text: str, target_side: str, key: str
) -> list[PatchEffect]:
    push, clean = target_sign(outcomes, target_side), outcomes.of(CLEAN)
    rows = [row for row, name in enumerate(outcomes.conditions) if name not in UNCHANGED]
    if not rows:
        return []
    names = [ConditionName.parse(outcomes.conditions[row]) for row in rows]
    displacements = push * (outcomes.displacement[rows] - clean)
    sign = swap_sign(outcomes) if target_side == IMAGE_SWAP else 1.0
    tests = test_against_controls(sign * displacements, names, outcomes, seed_text, (), ())
    found = []
    for at, (row, name, test) in enumerate(zip(rows, names, tests, strict=True)):
        flips = _flips(push, clean, outcomes.displacement[row])
        # The swap moves actions to the wrong side; steering to another side is compared with its size.
        share = share_of_swap(outcomes, -outcomes.correct_sign * displacements[at], seed_text)
        columns: dict[str, Any] = common_columns(outcomes, row, name)
        found.append(
            PatchEffect(
                category=category,
                **columns,
                coefficient=name.coefficient,
                effect=None if share is None else share.value,
                effect_ci=None if share is None else (share.low, share.high),
                net=float(flips.mean()),
                net_ci=net_interval(flips, outcomes, seed_text),
                net_left=_mean(flips[push > 0]),
                net_right=_mean(flips[push < 0]),
                mean_displacement=float(displacements[at].mean()),
                control_displacement=float(displacements[test.controls].mean()) if test.controls else None,
                t=test.t or 0.0,
                p=test.p,
                p_fwe=test.p_fwe,
                key=key,
            )
        )
    return found


def _flips(push: Values, clean: Values, edited: Values) -> Values:
    """(E,) 1 where the action flips to the target side, −1 where it flips away from it, else 0."""
    flips: NDArray[np.float64] = (push * edited > 0).astype(float) - (push * clean > 0)
    return flips


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if values.size else 0.0
