"""What an erasure did to where actions go. Reads stored outcomes; needs no model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.intervene.kinds.base import (
    ConditionName,
    EffectRow,
    Measurement,
    common_columns,
    test_against_controls,
)
from probe_kit.intervene.kinds.image_swap.effects import SMALLEST_EFFECT_OF_INTEREST, net_interval
from probe_kit.intervene.kinds.site_effects import LOCALISATION_SHARE
from probe_kit.intervene.store.answers import CLEAN, PROBE_ACCURACY, ConditionOutcomes
from probe_kit.statistics.paired_signs import paired_greater_p
from probe_kit.statistics.significance import SIGNIFICANCE

Finding = Literal[
    "identity patch", "control", "no baseline effect", "controls also disrupt", "effect", "no effect"
]
ProbeAccuracies = Mapping[str, Mapping[str, float]]
"""By condition and category."""
_NOTHING: ProbeAccuracies = {}
UNTOUCHED, ZERO = "none", "0"
"""Direction and coefficient of the condition in which tokens are written back as they are."""
CHANCE_LIKE = 0.6
"""Held-out accuracy below which a probe on two sides is said to be blind."""


@dataclass(frozen=True, kw_only=True)
class ErasureEffect(EffectRow):
    """What was left of an answer in the action once it was erased at one place, in one category; see `EffectRow`.

    right_before, right: share of episodes whose action goes to the correct picture's side, without and with the
    edit. kept: of how far actions go to the correct side, the share that is left; None if they do not go there,
    because a share of noise is noise. net: share of episodes that no longer go there minus those that do now.
    mean_displacement: metres away from the correct side. control_kept, control_net, control_displacement: means of
    the controls. p: exact and one-sided, that an item's action moves away from the correct picture farther than
    under the controls, by items and by groups, the larger one. p_fwe: of the same, by sign flips of whole groups
    against the largest t of the category. probe_accuracy_before, probe_accuracy: held-out accuracy of a fresh
    probe on the mean over tokens.
    """

    right_before: float
    right: float
    kept: float | None
    mean_displacement: float
    control_kept: float | None
    control_net: float | None
    control_displacement: float | None
    p: float | None
    p_fwe: float | None
    probe_accuracy_before: float | None
    probe_accuracy: float | None

    @property
    def finding(self) -> Finding:
        """`effect` if, beyond its controls and chance, enough of the answer is gone from the action."""
        if self.direction == UNTOUCHED:
            return "identity patch"
        if self.is_control:
            return "control"
        if self.kept is None:
            return "no baseline effect"
        beside = 1.0 if self.control_kept is None else self.control_kept
        if beside < LOCALISATION_SHARE:
            return "controls also disrupt"
        gone = self.p is not None and self.p < SIGNIFICANCE and beside - self.kept >= SMALLEST_EFFECT_OF_INTEREST
        return "effect" if gone else "no effect"

    @property
    def name(self) -> str:
        """What was edited, in a few words."""
        what = "identity patch" if self.direction == UNTOUCHED else self.direction
        return " ".join((self.place, self.role, what))

    def to_json(self) -> dict[str, Any]:
        """Plain values and the finding."""
        return {**super().to_json(), "finding": self.finding}


def measured_erasure(measurement: Measurement) -> list[ErasureEffect]:
    """The effects of a stored erasure."""
    read = measurement.certificate.get(PROBE_ACCURACY, {})
    return erasure_effects(measurement.outcomes, measurement.suite, measurement.key, read)


def erasure_effects(
    outcomes: ConditionOutcomes, suite: str, key: str = "", probe_accuracy: ProbeAccuracies = _NOTHING
) -> list[ErasureEffect]:
    """One per category and condition. probe_accuracy: as a certificate has it."""
    return [
        row
        for category, own in outcomes.by_category()
        for row in _of_category(own, category, suite, key, probe_accuracy)
    ]


def erasure_notes(rows: Sequence[ErasureEffect], _: Measurement) -> list[str]:
    """What a reader must know."""
    blind = [row for row in rows if row.finding == "no effect" and (row.probe_accuracy or 1.0) < CHANCE_LIKE]
    broken = [row for row in rows if row.finding == "controls also disrupt"]
    return [
        "Erasure is weaker evidence than interchange: what is read need not be linear, and may pass elsewhere. "
        "Loss beyond the controls is evidence of use. Absence of loss is not evidence against it.",
        *(f"{row.category}, {row.name}: the probe is at chance, and the action is as before." for row in blind),
        *(
            f"{row.category}, {row.name}: random subspaces of the same rank disrupt the action too."
            for row in broken
        ),
    ]


def _of_category(
    outcomes: ConditionOutcomes, category: str, suite: str, key: str, probe_accuracy: ProbeAccuracies
) -> list[ErasureEffect]:
    sign = outcomes.correct_sign
    clean = sign * outcomes.of(CLEAN)
    conditions = [name for name in outcomes.conditions if name != CLEAN]
    names = [ConditionName.parse(condition) for condition in conditions]
    values = np.array([sign * outcomes.of(condition) for condition in conditions])
    away = clean - values
    untouched = [at for at, name in enumerate(names) if name.coefficient]
    tests = test_against_controls(away, names, outcomes, suite, untouched, ())
    goes_there = paired_greater_p(clean, outcomes.items, outcomes.groups) < SIGNIFICANCE
    kept = values.sum(axis=1) / clean.sum() if goes_there else None
    net = (clean > 0).astype(float) - (values > 0)
    rows = []
    for at, (condition, name, test) in enumerate(zip(conditions, names, tests, strict=True)):
        columns: dict[str, Any] = common_columns(outcomes, outcomes.conditions.index(condition), name)
        before = str(ConditionName(name.place, name.role, UNTOUCHED, ZERO))
        rows.append(
            ErasureEffect(
                category=category,
                **columns,
                right_before=float((clean > 0).mean()),
                right=float((values[at] > 0).mean()),
                kept=None if kept is None else float(kept[at]),
                net=float(net[at].mean()),
                net_ci=net_interval(net[at], outcomes, suite),
                mean_displacement=float(away[at].mean()),
                control_kept=_mean(kept, test.controls),
                control_net=_mean(net.mean(axis=1), test.controls),
                control_displacement=_mean(away.mean(axis=1), test.controls),
                p=None if test.beyond is None else paired_greater_p(test.beyond, outcomes.items, outcomes.groups),
                p_fwe=test.p_fwe,
                probe_accuracy_before=probe_accuracy.get(before, {}).get(category),
                probe_accuracy=probe_accuracy.get(condition, {}).get(category),
                key=key,
            )
        )
    return rows


def _mean(values: NDArray[np.float64] | None, rows: Sequence[int]) -> float | None:
    return None if values is None or not rows else float(values[list(rows)].mean())
