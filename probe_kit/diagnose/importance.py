"""The share of the action that an input decides: total-effect indices, intervals and the verdict. Loads no model.

The index of an input is the share of the action's variance that is due to it, alone and together with other
inputs. It is the mean over pairs of frames

    S = mean of (a(x) − a(x with another value of the input))² / 2 V

by Jansen's estimator (M. Jansen, Computer Physics Communications 117, 1999; Saltelli et al., Computer Physics
Communications 181, 2010). V is the variance of the actions over frames and seeds. Both inferences of a pair have
the same seed.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._tables.numbers import whole_percent
from probe_kit.diagnose.results import (
    IDLE,
    MATTERS,
    BaseComparison,
    Change,
    InputDiagnosis,
    Verdict,
)
from probe_kit.hashing import derive_seed
from probe_kit.intervene.exchange import INPUTS_DECIDE, TRACE, describe_seed, does_seed_decide
from probe_kit.statistics.bootstrap import unbounded_student_interval
from probe_kit.statistics.paired_tests import least_column_p, max_t
from probe_kit.statistics.significance import SIGNIFICANCE

# The first two are choices, which `docs/diagnose.md` states as the rule.
DECIDES = 0.5
"""Share of the change by all inputs together from which an input decides: it outweighs all others together."""
LEAST_SPREAD = 1e-3
"""Share of the largest spread of a number of the action: numbers with less are constant but for rounding.

Divided by their own spread, such numbers would turn rounding into large changes.
"""


@dataclass(frozen=True)
class ActionScale:
    """The spread of every number of the action, over frames, seeds and the steps of a chunk.

    Attributes:
        spread: (D,) in the action's own units.
        varies: (D,) whether the number is compared.
    """

    spread: NDArray[np.float64]
    varies: NDArray[np.bool_]

    @classmethod
    def of(cls, actions: NDArray[np.float32]) -> "ActionScale":
        """Return the scale of clean actions (frames, chunk, D); a number's mean over frames may differ by step."""
        spread = np.sqrt(actions.astype(np.float64).var(axis=0).mean(axis=0))
        return cls(spread, spread > LEAST_SPREAD * spread.max(initial=0.0))

    def changes(self, first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the differences (pairs, chunk · varying) of actions (pairs, chunk, D), in units of the spread."""
        difference = first.astype(np.float64) - second
        return (difference[..., self.varies] / self.spread[self.varies]).reshape(len(difference), -1)

    def shares(self, first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return half the mean squared change (pairs,): the mean over pairs is the total-effect index."""
        if not self.varies.any():
            return np.zeros(len(first))
        shares: NDArray[np.float64] = (self.changes(first, second) ** 2).mean(axis=1) / 2
        return shares


@dataclass(frozen=True)
class Exchanges:
    """The changes of the action by exchanges of one input, pair by pair.

    `exchanged`, `control` and `every` are shares of the variance, see `ActionScale.shares`.

    Attributes:
        exchanged: (P,) with the donor's input.
        control: (P,) with the control of the input; None where the model takes none.
        every: (P,) with all inputs of the donor.
        groups: (P,) group of the pair's frame.
        frames: (P,) number of the pair's frame, ascending.
        repeated: (P,) whether an earlier donor of the frame holds the same value.
        largest: (P,) the largest change of any number of the action under the donor's input.
        blanked: (F,) the largest change of any number of every frame's action under the blank.
        seeded: (P,) share of the variance with another seed; None where it was not measured.
    """

    exchanged: NDArray[np.float64]
    control: NDArray[np.float64] | None
    every: NDArray[np.float64]
    groups: NDArray[np.str_]
    frames: NDArray[np.intp]
    repeated: NDArray[np.bool_]
    largest: NDArray[np.float64]
    blanked: NDArray[np.float64]
    seeded: NDArray[np.float64] | None = None

    @property
    def seed(self) -> float:
        """The share of the variance with another seed; NaN where it was not measured."""
        return np.nan if self.seeded is None else float(self.seeded.mean())


def importance_of(name: str, exchanges: Exchanges) -> InputDiagnosis:
    """Return the verdict on one input that was exchanged."""
    groups = exchanges.groups
    p = _more_than_control_p(name, exchanges)
    share_ci = unbounded_student_interval(exchanges.exchanged, groups)
    measured: dict[str, Any] = {
        "share": float(exchanges.exchanged.mean()),
        "share_ci": (max(0.0, share_ci[0]), share_ci[1]),
        "control": np.nan if exchanges.control is None else float(exchanges.control.mean()),
        "every": float(exchanges.every.mean()),
        "seed": exchanges.seed,
        "p": p,
        "n_pairs": groups.size,
        "n_groups": np.unique(groups).size,
        "n_inferences": exchanges.largest.size + exchanges.blanked.size,
        "unchanged": int((exchanges.largest == 0).sum() + (exchanges.blanked == 0).sum()),
    }
    verdict, reason = _verdict(exchanges, p)
    return InputDiagnosis(name, verdict, reason, **measured)


def _more_than_control_p(name: str, exchanges: Exchanges) -> float:
    """Return the p-value of the exchanged input against its control.

    It is the chance that an input which matters no more than its control changes the action this much more.
    """
    # The same value again is the same change: as a column of its own it would make the others look alike.
    fresh = np.flatnonzero(~exchanges.repeated)
    starts = np.unique(exchanges.frames[fresh], return_index=True)[1]
    donors = int(np.diff([*starts, fresh.size]).min())
    exchanged = exchanges.exchanged[fresh[starts[:, None] + np.arange(donors)]]
    of_frames = fresh[starts]
    control = np.zeros(len(starts)) if exchanges.control is None else exchanges.control[of_frames]
    # One change in ten turns the action around: without the logarithm, the few large ones are all that counts.
    sizes = np.log1p(np.column_stack([control, exchanged]) / TRACE)
    groups = exchanges.groups[of_frames]
    return least_column_p(sizes, groups, derive_seed(name, "control", *np.unique(groups).tolist()))


def compare_with_base(
    tuned: InputDiagnosis, base: InputDiagnosis, of_tuned: Exchanges, of_base: Exchanges
) -> BaseComparison:
    """Return the effect of fine-tuning on one input that was exchanged in the same pairs of both checkpoints."""
    difference, groups = of_tuned.exchanged - of_base.exchanged, of_tuned.groups
    seed = derive_seed(tuned.name, "base", *np.unique(groups).tolist())
    _, sides, _ = max_t(np.stack([difference, -difference]), of_tuned.frames, groups, seed)
    p = min(1.0, 2 * float(sides.min()))
    mean = float(difference.mean())
    change = _change(tuned.verdict, base.verdict, mean, p)
    limits = unbounded_student_interval(difference, groups)
    return BaseComparison(change, base.verdict, base.share, mean, limits, p)


def _change(tuned: Verdict, base: Verdict, difference: float, p: float) -> Change:
    """Return the change by fine-tuning.

    A loss or a gain needs both verdicts and a difference that is shown; anything less is open.
    """
    if tuned in IDLE and base in IDLE:
        return "never there"
    if tuned in MATTERS and base in MATTERS:
        return "in both" if p >= SIGNIFICANCE else "stronger" if difference > 0 else "weaker"
    if p < SIGNIFICANCE and base in MATTERS and difference < 0:
        return "lost in fine-tuning"
    return "gained" if p < SIGNIFICANCE and tuned in MATTERS and difference > 0 else "open"


def _verdict(exchanges: Exchanges, p: float) -> tuple[Verdict, str]:
    groups = exchanges.groups
    above = exchanges.exchanged - (0.0 if exchanges.control is None else exchanges.control)
    if not exchanges.largest.any():
        # A blank and another full stop are texts of other lengths: a length arrives where no word does.
        meaningless = {"a blank": exchanges.blanked, "its control": exchanges.control}
        changed = [
            f"{name} changes some in {np.count_nonzero(changes)} of {changes.size}"
            for name, changes in meaningless.items()
            if changes is not None and changes.any()
        ]
        return "does not arrive", "; ".join(
            [f"no number of any action changed in {exchanges.largest.size} exchanges", *changed]
        )
    if unbounded_student_interval(above, groups)[1] < TRACE:
        # No interval holds an effect in rare frames of which none was drawn: Clopper and Pearson's one-sided
        # upper limit of a share that none of the groups shows.
        unseen = 1 - SIGNIFICANCE ** (1 / np.unique(groups).size)
        return "no effect", f"in these frames; up to {whole_percent(unseen)} % of all frames may have one"
    if p >= SIGNIFICANCE:
        return "open", f"p {p:.2g} that it changes more than its control; more frames decide"
    # Both must be shown, each by a one-sided test. The ratio's interval in logarithms is narrower, and too narrow
    # where few exchanges turn the action around.
    over_half, _ = unbounded_student_interval(
        exchanges.exchanged - DECIDES * exchanges.every, groups, SIGNIFICANCE
    )
    inputs, _ = unbounded_student_interval(exchanges.every, groups, SIGNIFICANCE)
    if exchanges.seeded is not None:
        # Without noise all inputs together decide, however near donors are.
        outweighs, _ = unbounded_student_interval(exchanges.every - exchanges.seeded, groups, SIGNIFICANCE)
        inputs = INPUTS_DECIDE if outweighs > 0 else inputs
    if over_half >= 0 and inputs >= INPUTS_DECIDE:
        return "decides", "it changes at least half of what all inputs change together"
    if exchanges.control is None:
        return "open", "the model takes no other spelling of it as a control; give --paraphrases"
    if does_seed_decide(every := float(exchanges.every.mean()), exchanges.seed):
        return "moves", describe_seed(every)
    return "moves", "it changes less than half of what all inputs change together, or that was not shown"
