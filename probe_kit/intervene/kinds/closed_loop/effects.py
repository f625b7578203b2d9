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
from probe_kit.intervene.kinds.image_swap.effects import WORTH, net_interval
from probe_kit.intervene.kinds.site_effects import Named, beyond_controls, controls_of, ledger_sums
from probe_kit.intervene.store.answers import PLAIN, Answers
from probe_kit.statistics.mcnemar import sign_p
from probe_kit.statistics.sign_flips import max_t
from probe_kit.statistics.significance import SIGNIFICANCE

BROKEN = 0.5
"""Share of the plain in-zone share below which a hand is called broken."""
CORRECT, WRONG = "correct", "wrong"
Finding = Literal["dose 0", "control", "hand broken", "confirmed", "not confirmed"]


@dataclass(frozen=True)
class CarriedOut:
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
    hand_broken: bool
    changed: float
    fires: int
    still: int
    norm_ratio: float
    key: str = ""

    @property
    def finding(self) -> Finding:
        """`confirmed` if, beyond its controls and chance, enough episodes turn to the other picture."""
        if self.place == PLAIN:
            return "dose 0"
        if self.hand_broken:
            return "hand broken"
        if self.is_control:
            return "control"
        beyond = self.net - (self.control_net or 0.0)
        turned = self.p_fwe is not None and self.p_fwe < SIGNIFICANCE and beyond >= WORTH
        return "confirmed" if turned else "not confirmed"

    @property
    def name(self) -> str:
        """What was changed, in a few words."""
        return " ".join(filter(None, (self.place, self.role, self.direction)))

    def to_json(self) -> dict[str, Any]:
        """Plain values and the finding."""
        return {**asdict(self), "finding": self.finding}


def carried_out(answers: Answers, suite: str, key: str = "") -> list[CarriedOut]:
    """One per category and condition, dose 0 first. suite: its identity, of which intervals are drawn."""
    return [row for category, own in answers.by_category() for row in _of_category(own, category, suite, key)]


def _of_category(answers: Answers, category: str, suite: str, key: str) -> list[CarriedOut]:
    assert answers.outcomes is not None
    names = [Named.of(condition) for condition in answers.conditions]
    wrong = (answers.outcomes == WRONG).astype(float)
    in_zone = np.isin(answers.outcomes, (CORRECT, WRONG)).mean(axis=1)
    broken = in_zone < BROKEN * in_zone[0]
    net = wrong - wrong[0]
    controls = [[at for at in own if not broken[at]] for own in controls_of(names)]
    tested = [
        at for at, name in enumerate(names) if name.place != PLAIN and not name.is_control and not broken[at]
    ]
    found = _tests(answers, category, suite, net, controls, tested)
    rows = []
    for at, name in enumerate(names):
        gained, lost = int((net[at] > 0).sum()), int((net[at] < 0).sum())
        t, p, p_fwe = found.get(at, (None, None, None))
        rows.append(
            CarriedOut(
                category=category,
                place=name.place,
                role=name.role,
                direction=name.direction,
                is_control=name.is_control,
                n_episodes=wrong.shape[1],
                n_items=np.unique(answers.items).size,
                correct=float((answers.outcomes[at] == CORRECT).mean()),
                wrong=float(wrong[at].mean()),
                in_zone=float(in_zone[at]),
                wrong_in_zone=float(wrong[at].mean() / in_zone[at]) if in_zone[at] else None,
                net=float(net[at].mean()),
                net_ci=net_interval(net[at], answers, suite),
                net_left=_mean(net[at][answers.sides == "right"]),
                net_right=_mean(net[at][answers.sides == "left"]),
                control_net=float(net[controls[at]].mean()) if controls[at] else None,
                gained=gained,
                lost=lost,
                p_mcnemar=sign_p(gained, lost),
                t=t,
                p=p,
                p_fwe=p_fwe,
                hand_broken=bool(broken[at]),
                changed=float(answers.changed[at].max()),
                key=key,
                **ledger_sums(answers.ledger[at]),
            )
        )
    return rows


def _tests(
    answers: Answers,
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
    values = zip(*max_t(beyond, answers.items, answers.groups, seed), strict=True)
    return {at: (float(t), float(p), float(p_fwe)) for at, (t, p, p_fwe) in zip(tested, values, strict=True)}


def _mean(values: NDArray[np.float64]) -> float | None:
    return float(values.mean()) if values.size else None
