"""What changes inside the network did, place by place. Reads stored answers; needs no model.

Effects are signed: *toward* is the side on which the correct picture lies once the two are exchanged (an
interchange) or the side that was steered to. How often actions change sides says nothing by itself: they do so
away from it as well.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.hashing import derive_seed
from probe_kit.intervene.edits.patching import LOG_FIELDS
from probe_kit.intervene.kinds.image_swap.effects import image_swap_effects, net_interval
from probe_kit.intervene.store.answers import CLEAN, IMAGE_SWAP, UNCHANGED, ConditionOutcomes
from probe_kit.statistics.sign_flips import max_t
from probe_kit.statistics.significance import SIGNIFICANCE

Values = NDArray[np.float64]
CONTROL = "control-"
LOCALISATION_SHARE = 0.5
"""Share of the whole effect that a place must carry to be called one where it passes."""


@dataclass(frozen=True)
class ConditionName:
    """The parts of a condition's name: `place|role|direction|dose`, the last two where there are any."""

    place: str
    role: str = ""
    direction: str = ""
    coefficient: str = ""

    @classmethod
    def of(cls, condition: str) -> "ConditionName":
        """Take a name apart."""
        return cls(*condition.split("|"))

    @property
    def is_control(self) -> bool:
        """Whether its direction is a random one that another is held against."""
        return self.direction.startswith(CONTROL)

    def is_control_of(self, other: "ConditionName") -> bool:
        """Whether `other`, no control itself, is held against this one."""
        same = (self.place, self.role, self.coefficient) == (other.place, other.role, other.coefficient)
        return self.is_control and bool(other.direction) and not other.is_control and same


@dataclass(frozen=True)
class PatchEffect:
    """What a change at one place did, in one category.

    effect: share of what the whole exchange does to where the action goes; None if that does nothing, so that a
    share would be a ratio of noise. net: share of episodes whose action turns to the side it is pushed to, minus
    those that turn from it, with its 95 % interval by groups. shift, control_shift: mean metres toward that side,
    its own and of its matched controls. t, p, p_fwe: of the shift beyond the controls', one-sided, by sign flips
    of whole groups; p_fwe against the largest t of all changes of the category. changed: largest difference in any
    action of any episode; 0 is bit for bit. fires, still: fires of edited sites in all episodes, and those that
    moved nothing. norm_ratio: how far tokens were moved, in their own norms. net_left, net_right: by the side it
    is pushed to.
    """

    category: str
    place: str
    role: str
    direction: str
    coefficient: str
    is_control: bool
    n_episodes: int
    n_items: int
    effect: float | None
    net: float
    net_ci: tuple[float, float]
    net_left: float
    net_right: float
    mean_displacement: float
    control_displacement: float | None
    t: float
    p: float | None
    p_fwe: float | None
    max_action_change: float
    fires: int
    no_op_fires: int
    relative_change: float
    key: str = ""

    @property
    def is_localised(self) -> bool:
        """Whether it carries half of the effect, beyond chance among all that was tried."""
        enough = self.effect is not None and self.effect >= LOCALISATION_SHARE
        return enough and self.p_fwe is not None and self.p_fwe < SIGNIFICANCE

    @property
    def name(self) -> str:
        """What was changed, in a few words."""
        return " ".join(
            filter(None, (self.place, self.role, self.direction, self.coefficient and f"dose {self.coefficient}"))
        )

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def patch_effects(
    outcomes: ConditionOutcomes, suite: str, target_side: str = "exchanged", key: str = ""
) -> list[PatchEffect]:
    """One per category and change. toward: `exchanged`, or the side that was steered to, see `Steer`."""
    return [
        row
        for category, own in outcomes.by_category()
        for row in _of_category(own, category, suite, target_side, key)
    ]


def pushed_to(outcomes: ConditionOutcomes, target_side: str) -> NDArray[np.float64]:
    """(E,) the side that is pushed to, +1 for left."""
    fixed = {"left": 1.0, "right": -1.0}
    if target_side in fixed:
        return np.full(outcomes.correct_sign.size, fixed[target_side])
    return outcomes.correct_sign if target_side == "correct" else -outcomes.correct_sign


def _of_category(
    outcomes: ConditionOutcomes, category: str, suite: str, target_side: str, key: str
) -> list[PatchEffect]:
    push, plain = pushed_to(outcomes, target_side), outcomes.of(CLEAN)
    rows = [row for row, name in enumerate(outcomes.conditions) if name not in UNCHANGED]
    if not rows:
        return []
    names = [ConditionName.of(outcomes.conditions[row]) for row in rows]
    displacements = push * (outcomes.displacement[rows] - plain)
    controls = controls_of(names)
    tested = [at for at, name in enumerate(names) if not name.is_control]
    seed = derive_seed("sign flips", suite, category)
    t, p, p_fwe = max_t(beyond_controls(displacements, controls, tested), outcomes.items, outcomes.groups, seed)
    place_of = {at: place for place, at in enumerate(tested)}
    share = _shares(outcomes, rows, suite)
    found = []
    for at, name in enumerate(names):
        turned = _turned(push, plain, outcomes.displacement[rows[at]])
        tested_at = place_of.get(at)
        found.append(
            PatchEffect(
                category=category,
                place=name.place,
                role=name.role,
                direction=name.direction,
                coefficient=name.coefficient,
                is_control=name.is_control,
                n_episodes=plain.size,
                n_items=np.unique(outcomes.items).size,
                effect=None if share is None else float(share[at]),
                net=float(turned.mean()),
                net_ci=net_interval(turned, outcomes, suite),
                net_left=_mean(turned[push > 0]),
                net_right=_mean(turned[push < 0]),
                mean_displacement=float(displacements[at].mean()),
                control_displacement=float(displacements[controls[at]].mean()) if controls[at] else None,
                t=0.0 if tested_at is None else float(t[tested_at]),
                p=None if tested_at is None else float(p[tested_at]),
                p_fwe=None if tested_at is None else float(p_fwe[tested_at]),
                max_action_change=float(outcomes.max_action_change[rows[at]].max()),
                key=key,
                **ledger_sums(outcomes.edit_log[rows[at]]),
            )
        )
    return found


def controls_of(names: Sequence[ConditionName]) -> list[list[int]]:
    """For every condition, which others it is held against."""
    return [[at for at, other in enumerate(names) if other.is_control_of(name)] for name in names]


def beyond_controls(values: Values, controls: Sequence[list[int]], tested: Sequence[int]) -> Values:
    """(tested, E) what each does beyond the mean of its controls. values: (K, E). controls: rows, of every row."""
    beyond = [values[at] - values[controls[at]].mean(axis=0) if controls[at] else values[at] for at in tested]
    return np.array(beyond).reshape(len(tested), values.shape[1])


def ledger_sums(edit_log: Values) -> dict[str, Any]:
    """`fires`, `still` and `relative_change` of one condition. ledger: (E, 5), see `patching.LEDGER`."""
    of = dict(zip(LOG_FIELDS, edit_log.T, strict=True))
    norm = float((of["norm"] * of["fires"]).sum())
    return {
        "fires": int(of["fires"].sum()),
        "still": int(of["still"].sum()),
        "norm_ratio": float((of["moved"] * of["fires"]).sum()) / norm if norm else 0.0,
    }


def _turned(push: Values, plain: Values, max_action_change: Values) -> Values:
    """(E,) 1 where the action turns to the side it is pushed to, −1 where it turns from it, else 0."""
    turned: NDArray[np.float64] = (push * changed > 0).astype(float) - (push * plain > 0)
    return turned


def _shares(outcomes: ConditionOutcomes, rows: Sequence[int], suite: str) -> NDArray[np.float64] | None:
    """(S,) of what the exchange does; None if there was no exchange, or it does nothing."""
    if IMAGE_SWAP not in outcomes.conditions:
        return None
    (whole,) = image_swap_effects(outcomes, suite)
    if min(whole.follow_p, whole.reversal_p) >= SIGNIFICANCE:
        return None
    plain = outcomes.of(CLEAN)
    total = outcomes.of(IMAGE_SWAP) - plain
    found: NDArray[np.float64] = ((outcomes.displacement[rows] - plain) * total).sum(axis=1) / (total**2).sum()
    return found


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if values.size else 0.0
