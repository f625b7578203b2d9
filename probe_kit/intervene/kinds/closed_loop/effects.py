"""Where cubes ended under a change, held against where they ended without. Reads stored answers; needs no model.

Two things are said apart: which picture the cube was brought to, and whether it was brought to any. A change that
breaks the hand lowers a success rate as well as one that turns the choice, so that it enters no verdict.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.hashing import derive_seed
from probe_kit.intervene.kinds.image_swap.effects import SMALLEST_EFFECT_OF_INTEREST, net_interval
from probe_kit.intervene.kinds.site_effects import ConditionName, beyond_controls, controls_of, ledger_sums
from probe_kit.intervene.store.answers import CLEAN, ConditionOutcomes
from probe_kit.statistics.mcnemar import sign_p
from probe_kit.statistics.sign_flips import max_t
from probe_kit.statistics.significance import SIGNIFICANCE

MIN_IN_ZONE_RATIO = 0.5
"""Share of the plain in-zone share below which a hand is called broken."""
CORRECT, WRONG = "correct", "wrong"
Finding = Literal["dose 0", "control", "hand broken", "confirmed", "not confirmed"]


@dataclass(frozen=True)
class ClosedLoopEffect:
    """What one change did to whole episodes, in one category.

    correct, wrong, in_zone: shares of episodes. wrong_in_zone: share of wrong ones among those in a zone; None if
    there is none. net: share of episodes that end wrong minus that without the change, by episode, with its 95 %
    interval by groups; net_left, net_right: by the side of the wrong picture. control_net: mean of its controls
    whose hand is whole. gained, lost: episodes that end wrong only with the change, and only without; p_mcnemar:
    exact and two-sided, episodes of an item taken as independent, so that it is no verdict. t, p, p_fwe: of net
    beyond the controls', one-sided, by sign flips of whole groups; p_fwe against the largest t of the category;
    None for what enters no verdict. changed: largest difference of any number of any trajectory; 0 is bit for bit.
    fires, still: of edited sites, and those that moved nothing. norm_ratio: as in `Passing`.
    """

    category: str
    place: str
    role: str
    direction: str
    is_control: bool
    n_episodes: int
    n_items: int
    correct: float
    wrong: float
    in_zone: float
    wrong_in_zone: float | None
    net: float
    net_ci: tuple[float, float]
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
    max_action_change: float
    fires: int
    no_op_fires: int
    relative_change: float
    key: str = ""

    @property
    def finding(self) -> Finding:
        """`confirmed` if, beyond its controls and chance, enough episodes turn to the other picture."""
        if self.place == CLEAN:
            return "dose 0"
        if self.disrupted:
            return "hand broken"
        if self.is_control:
            return "control"
        beyond = self.net - (self.control_net or 0.0)
        turned = self.p_fwe is not None and self.p_fwe < SIGNIFICANCE and beyond >= SMALLEST_EFFECT_OF_INTEREST
        return "confirmed" if turned else "not confirmed"

    @property
    def name(self) -> str:
        """What was changed, in a few words."""
        return " ".join(filter(None, (self.place, self.role, self.direction)))

    def to_json(self) -> dict[str, Any]:
        """Plain values and the finding."""
        return {**asdict(self), "finding": self.finding}


def closed_loop_effects(outcomes: ConditionOutcomes, suite: str, key: str = "") -> list[ClosedLoopEffect]:
    """One per category and condition, dose 0 first. suite: its identity, of which intervals are drawn."""
    return [row for category, own in outcomes.by_category() for row in _of_category(own, category, suite, key)]


def _of_category(outcomes: ConditionOutcomes, category: str, suite: str, key: str) -> list[ClosedLoopEffect]:
    assert outcomes.episode_outcomes is not None
    names = [ConditionName.of(condition) for condition in outcomes.conditions]
    wrong = (outcomes.episode_outcomes == WRONG).astype(float)
    in_zone = np.isin(outcomes.episode_outcomes, (CORRECT, WRONG)).mean(axis=1)
    broken = in_zone < MIN_IN_ZONE_RATIO * in_zone[0]
    net = wrong - wrong[0]
    controls = [[at for at in own if not broken[at]] for own in controls_of(names)]
    tested = [
        at for at, name in enumerate(names) if name.place != CLEAN and not name.is_control and not broken[at]
    ]
    found = _tests(outcomes, category, suite, net, controls, tested)
    rows = []
    for at, name in enumerate(names):
        gained, lost = int((net[at] > 0).sum()), int((net[at] < 0).sum())
        t, p, p_fwe = found.get(at, (None, None, None))
        rows.append(
            ClosedLoopEffect(
                category=category,
                place=name.place,
                role=name.role,
                direction=name.direction,
                is_control=name.is_control,
                n_episodes=wrong.shape[1],
                n_items=np.unique(outcomes.items).size,
                correct=float((outcomes.episode_outcomes[at] == CORRECT).mean()),
                wrong=float(wrong[at].mean()),
                in_zone=float(in_zone[at]),
                wrong_in_zone=float(wrong[at].mean() / in_zone[at]) if in_zone[at] else None,
                net=float(net[at].mean()),
                net_ci=net_interval(net[at], outcomes, suite),
                net_left=_mean(net[at][outcomes.sides == "right"]),
                net_right=_mean(net[at][outcomes.sides == "left"]),
                control_net=float(net[controls[at]].mean()) if controls[at] else None,
                gained=gained,
                lost=lost,
                p_mcnemar=sign_p(gained, lost),
                t=t,
                p=p,
                p_fwe=p_fwe,
                disrupted=bool(broken[at]),
                max_action_change=float(outcomes.max_action_change[at].max()),
                key=key,
                **ledger_sums(outcomes.edit_log[at]),
            )
        )
    return rows


def _tests(
    outcomes: ConditionOutcomes,
    category: str,
    suite: str,
    net: NDArray[np.float64],
    controls: Sequence[list[int]],
    tested: Sequence[int],
) -> dict[int, tuple[float, float, float]]:
    """t, p and family-wise p of those conditions that may enter a verdict."""
    if not tested:
        return {}
    beyond = beyond_controls(net, controls, tested)
    seed = derive_seed("sign flips", suite, category)
    values = zip(*max_t(beyond, outcomes.items, outcomes.groups, seed), strict=True)
    return {at: (float(t), float(p), float(p_fwe)) for at, (t, p, p_fwe) in zip(tested, values, strict=True)}


def _mean(values: NDArray[np.float64]) -> float | None:
    return float(values.mean()) if values.size else None
