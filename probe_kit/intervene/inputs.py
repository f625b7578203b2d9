"""The effect of one input on the action of a run without sides. Reads stored outcomes; needs no model."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from probe_kit.intervene.outcomes import CLEAN, CONTROL_INPUT, DONOR, ConditionOutcomes, Effect
from probe_kit.intervene.patching.sets import NOTHING, carries_nothing
from probe_kit.intervene.patching.sweep import SwapShare, share_fields, share_of_whole
from probe_kit.statistics.paired_tests import paired_greater_p
from probe_kit.statistics.significance import SIGNIFICANCE

Finding = Literal["decides", "moves", "no effect", "open"]
DECIDES = 0.5
"""Share of the exchange of all inputs from which an input decides; within ±`NOTHING` it has no effect."""


@dataclass(frozen=True, kw_only=True)
class InputEffect(Effect):
    """The effect of one input, in one category, without sides; sizes are in spreads of clean actions.

    vary: the input that was exchanged for a donor's. changed: share of pairs in which any number of the action
    changed; 0 means that the input does not arrive. size, control_size, full_size: mean size of the change by the
    donor's input, by its control and by all of the donor's inputs. share, share_ci: displacement toward the
    donor's action by this input, as a share of the exchange of all inputs, with its 95 % interval by groups; None
    where that changes nothing. p: exact and one-sided, that the change is larger than the control's, by items and
    by groups, the larger one. finding: `decides`, `moves`, `no effect` within the bound, or `open`.
    """

    vary: str
    n_episodes: int
    n_items: int
    n_groups: int
    changed: float
    size: float
    control_size: float
    full_size: float
    share: float | None
    share_ci: tuple[float, float] | None
    p: float
    finding: Finding
    key: str = ""


def input_effects(
    outcomes: ConditionOutcomes, swapped: str, vary: str, seed_text: str, key: str = ""
) -> list[InputEffect]:
    """Return one per category. swapped: the condition in which the input is the donor's."""
    return [
        _input_effect(part, category, swapped, vary, seed_text, key) for category, part in outcomes.by_category()
    ]


def _input_effect(
    outcomes: ConditionOutcomes, category: str, swapped: str, vary: str, seed_text: str, key: str
) -> InputEffect:
    assert outcomes.size is not None
    at, control, full = (outcomes.conditions.index(name) for name in (swapped, CONTROL_INPUT, DONOR))
    size, control_size, full_size = outcomes.size[[at, control, full]]
    clean, exchange = outcomes.of(CLEAN), outcomes.of(DONOR) - outcomes.of(CLEAN)
    share = (
        share_of_whole(outcomes.of(swapped) - clean, exchange, outcomes.groups, seed_text)
        if exchange.any()
        else None
    )
    p = paired_greater_p(size - control_size, outcomes.items, outcomes.groups)
    ratio = float(size.sum() / full_size.sum()) if full_size.any() else 0.0
    return InputEffect(
        category=category,
        vary=vary,
        n_episodes=size.size,
        n_items=np.unique(outcomes.items).size,
        n_groups=np.unique(outcomes.groups).size,
        changed=float((outcomes.max_action_change[at] > 0).mean()),
        size=float(size.mean()),
        control_size=float(control_size.mean()),
        full_size=float(full_size.mean()),
        **share_fields("share", share),
        p=p,
        finding=_finding(share, p, ratio),
        key=key,
    )


def _finding(share: SwapShare | None, p: float, ratio: float) -> Finding:
    """Return the verdict of an input. ratio: of its change to that by all inputs."""
    if share is None:
        return "open"
    beyond = p < SIGNIFICANCE
    if beyond and share.value >= DECIDES and share.low > NOTHING:
        return "decides"
    if carries_nothing(share.low, share.high) and (not beyond or ratio < NOTHING):
        return "no effect"
    return "moves" if beyond else "open"


INPUT_LEGEND = (
    "size: mean change of the action in spreads of clean actions, by the donor's input; control: by a change of "
    "it that means nothing; full: by all of the donor's inputs; share: displacement toward the donor's action, of "
    f"the full exchange; decides: from {DECIDES}; no effect: within ±{NOTHING}; p: exact, that the change is "
    "larger than the control's, by item and by group, the larger one"
)
_VERBS: Mapping[str, str] = {
    "decides": "decides the action",
    "moves": "moves the action and does not decide it",
    "no effect": "has no effect",
    "open": "has an effect that remains open",
}


def find_input(row: InputEffect) -> str:
    """Return the finding of one input, a verdict and what the action does, without brackets."""
    if not row.changed:
        return f"does not arrive: another {row.vary} changes no number of any action"
    share = "" if row.share is None else f", by {row.share:.2f} of what all inputs do"
    return {
        "decides": f"decides: the action follows the {row.vary}{share}",
        "moves": f"moves: the {row.vary} shifts the action without deciding it{share}",
        "no effect": f"no effect: another {row.vary} leaves the action where it is",
        "open": f"open: the items do not tell whether the {row.vary} matters",
    }[row.finding]


def describe_input(row: InputEffect) -> str:
    """Return the finding of one input, as the end of a sentence."""
    if not row.changed:
        return f"the {row.vary} does not arrive: it changes no number of any action"
    share = "n/a" if row.share is None else f"{row.share:.2f}"
    return f"the {row.vary} {_VERBS[row.finding]} ({share} of the full exchange)"
