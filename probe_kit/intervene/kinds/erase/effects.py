"""What erasing did to where actions go. Reads stored answers; needs no model."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.hashing import derive_seed
from probe_kit.intervene.kinds.image_swap.effects import SMALLEST_EFFECT_OF_INTEREST, net_interval
from probe_kit.intervene.kinds.site_effects import (
    LOCALISATION_SHARE,
    ConditionName,
    beyond_controls,
    controls_of,
    ledger_sums,
)
from probe_kit.intervene.store.answers import CLEAN, ConditionOutcomes
from probe_kit.statistics.paired_signs import paired_greater_p
from probe_kit.statistics.sign_flips import max_t
from probe_kit.statistics.significance import SIGNIFICANCE

Finding = Literal["dose 0", "control", "nothing to lose", "controls break too", "lost", "kept"]
Readable = Mapping[str, Mapping[str, float]]
_NOTHING: Readable = {}


@dataclass(frozen=True)
class ErasureEffect:
    """What was left of an answer in the action once it was erased at one place, in one category.

    right_before, right: share of episodes whose action goes to the correct picture's side, without and with the
    change. kept: of how far actions go to the correct side, the share that is left; None if they do not go there,
    because a share of noise is noise. net: share of episodes that no longer go there minus those that do now, with
    its 95 % interval by groups. shift: mean metres away from the correct side. control_kept, control_net,
    control_shift: means of the controls. p: exact and one-sided, that an item's action moves away from the correct
    picture farther than under the controls, by items and by groups, the larger one. p_fwe: of the same, by sign
    flips of whole groups against the largest t of the category. readable_before, readable: held-out accuracy of a
    fresh probe on the mean over tokens. changed, fires, still, norm_ratio: as in `Passing`.
    """

    category: str
    place: str
    role: str
    direction: str
    is_control: bool
    n_episodes: int
    n_items: int
    right_before: float
    right: float
    kept: float | None
    net: float
    net_ci: tuple[float, float]
    mean_displacement: float
    control_kept: float | None
    control_net: float | None
    control_displacement: float | None
    p: float | None
    p_fwe: float | None
    probe_accuracy_before: float | None
    probe_accuracy: float | None
    max_action_change: float
    fires: int
    no_op_fires: int
    relative_change: float
    key: str = ""

    @property
    def finding(self) -> Finding:
        """`lost` if, beyond its controls and chance, enough of the answer is gone from the action."""
        if self.direction == "none":
            return "dose 0"
        if self.is_control:
            return "control"
        if self.kept is None:
            return "nothing to lose"
        beside = 1.0 if self.control_kept is None else self.control_kept
        if beside < LOCALISATION_SHARE:
            return "controls break too"
        gone = self.p is not None and self.p < SIGNIFICANCE and beside - self.kept >= SMALLEST_EFFECT_OF_INTEREST
        return "lost" if gone else "kept"

    @property
    def name(self) -> str:
        """What was changed, in a few words."""
        return " ".join((self.place, self.role, "dose 0" if self.direction == "none" else self.direction))

    def to_json(self) -> dict[str, Any]:
        """Plain values and the finding."""
        return {**asdict(self), "finding": self.finding}


def erasure_effects(
    outcomes: ConditionOutcomes, suite: str, key: str = "", probe_accuracy: Readable = _NOTHING
) -> list[ErasureEffect]:
    """One per category and condition. readable: by condition and category, as a certificate has it."""
    return [
        row
        for category, own in outcomes.by_category()
        for row in _of_category(own, category, suite, key, probe_accuracy)
    ]


def _of_category(
    outcomes: ConditionOutcomes, category: str, suite: str, key: str, probe_accuracy: Readable
) -> list[ErasureEffect]:
    target_side = outcomes.correct_sign
    plain = target_side * outcomes.of(CLEAN)
    conditions = [name for name in outcomes.conditions if name != CLEAN]
    names = [ConditionName.of(condition) for condition in conditions]
    values = np.array([target_side * outcomes.of(condition) for condition in conditions])
    controls = controls_of(names)
    tested = [at for at, name in enumerate(names) if not name.is_control and not name.coefficient]
    away = plain - values
    beyond = beyond_controls(away, controls, tested)
    _, _, p_fwe = max_t(beyond, outcomes.items, outcomes.groups, derive_seed("sign flips", suite, category))
    place_of = {at: row for row, at in enumerate(tested)}
    goes_there = paired_greater_p(plain, outcomes.items, outcomes.groups) < SIGNIFICANCE
    kept = values.sum(axis=1) / plain.sum() if goes_there else None
    net = (plain > 0).astype(float) - (values > 0)
    rows = []
    for at, (condition, name) in enumerate(zip(conditions, names, strict=True)):
        row, beside = outcomes.conditions.index(condition), controls[at]
        tested_at = place_of.get(at)
        rows.append(
            ErasureEffect(
                category=category,
                place=name.place,
                role=name.role,
                direction=name.direction,
                is_control=name.is_control,
                n_episodes=plain.size,
                n_items=np.unique(outcomes.items).size,
                right_before=float((plain > 0).mean()),
                right=float((values[at] > 0).mean()),
                kept=None if kept is None else float(kept[at]),
                net=float(net[at].mean()),
                net_ci=net_interval(net[at], outcomes, suite),
                mean_displacement=float(away[at].mean()),
                control_kept=_mean(kept, beside),
                control_net=_mean(net.mean(axis=1), beside),
                control_displacement=_mean(away.mean(axis=1), beside),
                p=None
                if tested_at is None
                else paired_greater_p(beyond[tested_at], outcomes.items, outcomes.groups),
                p_fwe=None if tested_at is None else float(p_fwe[tested_at]),
                probe_accuracy_before=probe_accuracy.get(f"{name.place}|{name.role}|none|0", {}).get(category),
                probe_accuracy=probe_accuracy.get(condition, {}).get(category),
                max_action_change=float(outcomes.max_action_change[row].max()),
                key=key,
                **ledger_sums(outcomes.edit_log[row]),
            )
        )
    return rows


def _mean(values: NDArray[np.float64] | None, rows: Sequence[int]) -> float | None:
    return None if values is None or not rows else float(values[list(rows)].mean())
