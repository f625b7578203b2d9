"""Where cubes ended under an edit, compared with where they ended without. Reads stored outcomes; needs no model.

Two things are kept apart: which picture the cube was brought to, and whether it was brought to any. An edit that
disrupts the task lowers a success rate as well as one that turns the choice, so that it enters no verdict.
"""

from collections.abc import Sequence
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
from probe_kit.intervene.store.answers import CLEAN, ConditionOutcomes
from probe_kit.statistics.mcnemar import sign_p
from probe_kit.statistics.significance import SIGNIFICANCE

MIN_IN_ZONE_RATIO = 0.5
"""Share of the clean in-zone share below which the task is called disrupted."""
CORRECT, WRONG = "correct", "wrong"
Finding = Literal["identity patch", "control", "task disrupted", "confirmed", "not confirmed"]


@dataclass(frozen=True, kw_only=True)
class ClosedLoopEffect(EffectRow):
    """What one edit did to whole episodes, in one category; see `EffectRow`.

    correct, wrong, in_zone: shares of episodes. wrong_in_zone: share of wrong ones among those in a zone; None if
    there is none. net: share of episodes that end wrong minus that without the edit; net_left, net_right: by the
    side of the wrong picture. control_net: mean of its controls that do not disrupt the task. gained, lost:
    episodes that end wrong only with the edit, and only without; p_mcnemar: exact and two-sided, episodes of an
    item taken as independent, so that it is no verdict. t, p, p_fwe: of net beyond the controls', one-sided, by
    sign flips of whole groups; p_fwe against the largest t of the category; None for what enters no verdict.
    disrupted: whether the cube is in a zone less than half as often. max_action_change: of any number of any
    trajectory.
    """

    correct: float
    wrong: float
    in_zone: float
    wrong_in_zone: float | None
    net_left: float | None
    net_right: float | None
    control_net: float | None
    gained: int
    lost: int
    p_mcnemar: float
    t: float | None
    p: float | None
    p_fwe: float | None
    disrupted: bool

    @property
    def finding(self) -> Finding:
        """`confirmed` if, beyond its controls and chance, enough episodes turn to the other picture."""
        if self.place == CLEAN:
            return "identity patch"
        if self.disrupted:
            return "task disrupted"
        if self.is_control:
            return "control"
        beyond = self.net - (self.control_net or 0.0)
        turned = self.p_fwe is not None and self.p_fwe < SIGNIFICANCE and beyond >= SMALLEST_EFFECT_OF_INTEREST
        return "confirmed" if turned else "not confirmed"

    def to_json(self) -> dict[str, Any]:
        """Plain values and the finding."""
        return {**super().to_json(), "finding": self.finding}


def measured_closed_loop(measurement: Measurement) -> list[ClosedLoopEffect]:
    """The effects of a stored closed loop."""
    return closed_loop_effects(measurement.outcomes, measurement.seed_text, measurement.key)


def closed_loop_effects(outcomes: ConditionOutcomes, seed_text: str, key: str = "") -> list[ClosedLoopEffect]:
    """One per category and condition, the identity patch first. seed_text: of the run, for intervals."""
    return [row for category, own in outcomes.by_category() for row in _of_category(own, category, seed_text, key)]


def disruption_notes(rows: Sequence[ClosedLoopEffect], _: Measurement) -> list[str]:
    """What a reader must know."""
    return [
        f"{row.category}, {row.name}: the cube is in a zone in {100 * row.in_zone:.0f} % of episodes; the task is "
        "disrupted, and this enters no verdict."
        for row in rows
        if row.disrupted
    ]


def _of_category(outcomes: ConditionOutcomes, category: str, seed_text: str, key: str) -> list[ClosedLoopEffect]:
    assert outcomes.episode_outcomes is not None
    names = [ConditionName.parse(condition) for condition in outcomes.conditions]
    wrong = (outcomes.episode_outcomes == WRONG).astype(float)
    in_zone = np.isin(outcomes.episode_outcomes, (CORRECT, WRONG)).mean(axis=1)
    disrupted = in_zone < MIN_IN_ZONE_RATIO * in_zone[0]
    net = wrong - wrong[0]
    left_out = set(np.flatnonzero(disrupted).tolist())
    clean = {at for at, name in enumerate(names) if name.place == CLEAN}
    tests = test_against_controls(net, names, outcomes, seed_text, left_out | clean, left_out)
    rows = []
    for at, (name, test) in enumerate(zip(names, tests, strict=True)):
        gained, lost = int((net[at] > 0).sum()), int((net[at] < 0).sum())
        columns: dict[str, Any] = common_columns(outcomes, at, name)
        rows.append(
            ClosedLoopEffect(
                category=category,
                **columns,
                correct=float((outcomes.episode_outcomes[at] == CORRECT).mean()),
                wrong=float(wrong[at].mean()),
                in_zone=float(in_zone[at]),
                wrong_in_zone=float(wrong[at].mean() / in_zone[at]) if in_zone[at] else None,
                net=float(net[at].mean()),
                net_ci=net_interval(net[at], outcomes, seed_text),
                net_left=_mean(net[at][outcomes.sides == "right"]),
                net_right=_mean(net[at][outcomes.sides == "left"]),
                control_net=float(net[test.controls].mean()) if test.controls else None,
                gained=gained,
                lost=lost,
                p_mcnemar=sign_p(gained, lost),
                t=test.t,
                p=test.p,
                p_fwe=test.p_fwe,
                disrupted=bool(disrupted[at]),
                key=key,
            )
        )
    return rows


def _mean(values: NDArray[np.float64]) -> float | None:
    return float(values.mean()) if values.size else None
