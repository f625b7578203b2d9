"""Image swap: with the two images swapped, and nothing else, does the action change sides?

Every episode is inferred twice, with the same state and noise. Displacements are in units of the policy's own
reach, the lateral distance between its actions to either side. In runs without sides, one input is exchanged for a
donor's, and sizes are in spreads (standard deviations) of the clean actions.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import plural
from probe_kit._tables.content import Cell as TableCell
from probe_kit._tables.numbers import number
from probe_kit.hooks.contract.declared import InterventionKind, Readout
from probe_kit.intervene.exchange import (
    NOTHING,
    TRACE,
    SwapShare,
    carries_nothing,
    describe_seed,
    does_seed_decide,
    share_fields,
    share_of_variance,
    share_of_whole,
)
from probe_kit.intervene.kinds.base import (
    EffectColumn,
    Intervention,
    centimetres,
    effect_table,
    interval_cell,
    is_resolved,
    lines_of,
    net_interval,
    p_of,
    rate,
    signed_interval,
)
from probe_kit.intervene.outcomes import CLEAN, CONTROL_INPUT, DONOR, IMAGE_SWAP, NOISE, ConditionOutcomes, Effect
from probe_kit.intervene.replay import CLEAN_RUN, CONTROL_RUN, DONOR_RUN, NOISE_RUN, SOURCE_RUN, Condition
from probe_kit.intervene.settings import FIRST_CHUNK
from probe_kit.intervene.stored import TILES_APART, Measurement, preferred_by_category
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.bootstrap import unbounded_student_interval
from probe_kit.statistics.paired_tests import paired_greater_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.sufficiency import SMALLEST_EFFECT_OF_INTEREST
from probe_kit.suite.categories import category_of

if TYPE_CHECKING:
    from probe_kit._tables.table import Table
    from probe_kit.intervene.sessions import ReplaySession

NAME = "image-swap"
FEWEST_TO_EITHER_SIDE = 8
"""Clean inferences that must go to either side before a reach is taken from them: a median of fewer jumps."""
SMALLEST_REACH = 0.02
"""Least reach in metres. Two sides that are nearer are no choice between tiles, which are 0.31 m apart."""
REACHED = 0.25
"""Share of the reach, from the middle, where a side counts as reached: half-way, as the side is at 0.5."""
SMALLEST_SHARE_OF_INTEREST = 0.10
"""Share of the reach below which a displacement is a trace.

It is chosen, as the bound within which *not used* must lie.
"""
FOLLOWS, REVERSES = 1, -1
"""Responses of an episode to a swap; 0 is neither."""
_REACH = {
    "actions": "reach: {:.1f} cm between the actions that go left and those that go right",
    "tiles": "reach: {:.1f} cm, the distance between the tiles, since too few actions go to one of the sides",
}


# -- the exchange of an input, without sides -----------------------------------------------------------------


SwapFinding = Literal["decides", "moves", "no effect", "open"]
DECIDES = 0.5
"""Share of the exchange of all inputs from which an input decides; within ±`NOTHING` it has no effect."""


@dataclass(frozen=True, kw_only=True)
class InputEffect(Effect):
    """The effect of one input, in one category, without sides; sizes are in spreads of clean actions.

    Attributes:
        vary: The input that was exchanged for a donor's.
        changed: Share of pairs in which any number of the action changed; 0 means that the input does not arrive.
        size: Mean size of the action's change by the donor's input.
        control_size: Mean size of its change by the control of that input.
        full_size: Mean size of its change by all of the donor's inputs.
        share: Displacement toward the donor's action by this input, as a share of the exchange of all inputs. None
            where that changes nothing.
        share_ci: The 95 % interval of `share`, by groups; None likewise.
        p: Exact one-sided p-value that the change is larger than the control's, by items and by groups, the larger
            one.
        finding: Verdict in a word: `decides`, `moves`, `no effect` within the bound, or `open`.
        every: Share of the actions' variance that all of the donor's inputs change, as in `probe-kit diagnose`.
        seed: Share of the variance that another seed changes; None where that was not played.
        key: Key of the intervention.
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
    finding: SwapFinding
    every: float = 1.0
    seed: float | None = None
    key: str = ""

    @property
    def is_of_the_seed(self) -> bool:
        """Whether the seed decides the action, and all inputs together hardly do."""
        return does_seed_decide(self.every, np.nan if self.seed is None else self.seed)


def input_effect(outcomes: ConditionOutcomes, swapped: str, vary: str) -> InputEffect:
    """Return the effect of one input in one category.

    Args:
        outcomes: Outcomes of one category.
        swapped: Name of the condition in which the input is the donor's.
        vary: Name of the input.
    """
    assert outcomes.size is not None
    at, control, full = (outcomes.conditions.index(name) for name in (swapped, CONTROL_INPUT, DONOR))
    size, control_size, full_size = outcomes.size[[at, control, full]]
    clean = outcomes.of(CLEAN)
    share = share_of_whole(
        outcomes.of(swapped) - clean, outcomes.of(DONOR) - clean, outcomes.groups, outcomes.seed_text
    )
    p = paired_greater_p(size - control_size, outcomes.items, outcomes.groups)
    ratio = float(size.sum() / full_size.sum()) if full_size.any() else 0.0
    every, seed = float(share_of_variance(full_size).mean()), None
    if NOISE in outcomes.conditions:
        seed = float(share_of_variance(outcomes.size[outcomes.conditions.index(NOISE)]).mean())
    above = share_of_variance(size) - share_of_variance(control_size)
    is_trace = unbounded_student_interval(above, outcomes.groups)[1] < TRACE
    return InputEffect(
        **outcomes.counts,
        vary=vary,
        changed=float((outcomes.max_action_change[at] > 0).mean()),
        size=float(size.mean()),
        control_size=float(control_size.mean()),
        full_size=float(full_size.mean()),
        **share_fields("share", share),
        p=p,
        finding=_finding(share, p, ratio, does_seed_decide(every, np.nan if seed is None else seed), is_trace),
        every=every,
        seed=seed,
    )


def _finding(share: SwapShare | None, p: float, ratio: float, by_seed: bool, is_trace: bool) -> SwapFinding:
    """Return the verdict of an input.

    Where the seed decides, a share of the exchange of all inputs is a share of nothing; the rules are then those
    of `probe-kit diagnose`.

    Args:
        share: Share of the exchange of all inputs; None where that changes nothing.
        p: The p-value that the change is larger than the control's.
        ratio: Size of its change over that by all inputs.
        by_seed: Whether the seed decides the action, see `does_seed_decide`.
        is_trace: Whether its own share of the variance, beyond the control's, is shown to be a trace.
    """
    if share is None:
        return "open"
    beyond = p < SIGNIFICANCE
    if by_seed:
        return "no effect" if is_trace else "moves" if beyond else "open"
    if beyond and share.value >= DECIDES and share.low > NOTHING:
        return "decides"
    if carries_nothing(share.low, share.high) and (not beyond or ratio < NOTHING):
        return "no effect"
    return "moves" if beyond else "open"


_VERBS: Mapping[str, str] = {
    "decides": "decides the action",
    "moves": "moves the action and does not decide it",
    "no effect": "has no effect",
    "open": "has an effect that remains open",
}
_INPUT_COLUMNS = (
    EffectColumn[InputEffect]("changed %", lambda row: rate(row.changed)),
    EffectColumn[InputEffect](
        "size",
        lambda row: TableCell(row.size, number),
        "size: mean change of the action by the donor's input, in spreads (standard deviations) of the clean "
        "actions",
    ),
    EffectColumn[InputEffect](
        "control",
        lambda row: TableCell(row.control_size, number),
        "control: the same by a change of it that means nothing, such as a full stop more or less",
    ),
    EffectColumn[InputEffect](
        "full",
        lambda row: TableCell(row.full_size, number),
        "full: the same by all of the donor's inputs together",
    ),
    EffectColumn[InputEffect](
        "share [95 %]",
        lambda row: interval_cell(row.share, row.share_ci),
        "share: displacement toward the donor's action by this input, as a share of that by all inputs",
    ),
    EffectColumn[InputEffect](
        "p",
        lambda row: p_of(row.p, is_resolved(row.size)),
        "p: exact, of a larger change than the control's; the larger of the tests by item and by group",
    ),
    EffectColumn[InputEffect]("n (episodes)", lambda row: TableCell(row.n_episodes, after=f" ({row.n_items})")),
    EffectColumn[InputEffect](
        "finding", lambda row: row.finding, f"decides: from {DECIDES}; no effect: within ±{NOTHING}"
    ),
)


def _find_input(row: InputEffect) -> str:
    """Return a verdict and the action's response, without brackets."""
    if not row.changed:
        return f"does not arrive: another {row.vary} changes no number of any action"
    share = "" if row.share is None else f", by {row.share:z.2f} of what all inputs do"
    remark = f"; {describe_seed(row.every)}" if row.is_of_the_seed else ""
    share = remark or share
    return {
        "decides": f"decides: the action follows the {row.vary}{share}",
        "moves": f"moves: the {row.vary} shifts the action without deciding it{share}",
        "no effect": f"no effect: another {row.vary} hardly changes the action{remark}",
        "open": f"open: these items do not decide whether the {row.vary} matters{remark}",
    }[row.finding]


def _describe_input(row: InputEffect) -> str:
    """Return the verdict of an input as the end of a sentence."""
    if not row.changed:
        return f"the {row.vary} does not arrive: it changes no number of any action"
    share = "n/a" if row.share is None else f"{row.share:z.2f}"
    what = describe_seed(row.every) if row.is_of_the_seed else f"{share} of the full exchange"
    return f"the {row.vary} {_VERBS[row.finding]} ({what})"


# -- effects of a swap ---------------------------------------------------------------------------------------


class Reach(NamedTuple):
    """The lateral distance between a policy's own two choices.

    Attributes:
        metres: The distance; more than zero.
        source: Origin of the distance. `actions` are the clean inferences of all categories. `tiles` is the
            distance between the tiles, where too few inferences go to one of the sides.
    """

    metres: float
    source: Literal["actions", "tiles"]

    @classmethod
    def of(cls, clean: NDArray[np.float64], tiles_apart: float = TILES_APART) -> "Reach":
        """Return the reach of (E,) clean displacements in metres, left positive, over all categories.

        The reach is a difference of medians: a few categories in which the policy moves weakly do not shorten it.
        """
        to_left, to_right = clean[clean > 0], clean[clean < 0]
        if min(to_left.size, to_right.size) >= FEWEST_TO_EITHER_SIDE:
            metres = float(np.median(to_left) - np.median(to_right))
            if metres >= SMALLEST_REACH:
                return cls(metres, "actions")
        return cls(tiles_apart, "tiles")


@dataclass(frozen=True, kw_only=True)
class ImageSwapEffect(Effect):
    """The effect of a swap on the actions, in one category.

    Attributes:
        follow_rate: Share of episodes in which the action goes to the correct picture, and to the other side once
            the two are swapped.
        reversal_rate: Share of episodes in which it does the reverse.
        net_follow_rate: Difference of the two rates.
        net_follow_rate_ci: The 95 % interval of `net_follow_rate`, by groups.
        follow_p: Exact one-sided p-value that an item's action moves toward the correct picture more often than by
            chance, by items and by groups, the larger one.
        reversal_p: The same p-value for moves away from the correct picture.
        median_displacement: Median distance between the two actions, in metres.
        reach: Metres of the policy's reach, see `Reach`.
        reach_source: Origin of the reach, see `Reach`.
        reach_share: Mean displacement toward the correct picture in units of the reach, 1 for a whole change of
            sides.
        reach_share_ci: Student's 95 % interval of `reach_share`, by groups.
        moved_share: Mean displacement in units of the reach, whichever way the action moves.
        left_reached: Share of the episodes with the correct picture on the left that reach it, minus that share
            with swapped images. Reached is what lies beyond a quarter of the reach from the middle.
        right_reached: The same of the episodes with the correct picture on the right.
        readout: Readout of all displacements, `first-chunk` or `per-step`.
        key: Key of the stored intervention.
    """

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

    @property
    def is_resolved(self) -> bool:
        """Whether it turns any episode, or moves the action by as much as the resolution of the measure."""
        return is_resolved(self.follow_rate, self.reversal_rate, self.reach_share)


def image_swap_effects(measurement: Measurement) -> list[ImageSwapEffect]:
    """Return one row per category, in the order of the episodes."""
    reach = Reach.of(measurement.outcomes.of(CLEAN), measurement.tiles_apart)
    return measurement.rows(
        lambda part: [ImageSwapEffect(**swap_columns(part, IMAGE_SWAP, reach), readout=measurement.readout)]
    )


def swap_columns(outcomes: ConditionOutcomes, swapped: str, reach: Reach) -> dict[str, Any]:
    """Return the columns of `ImageSwapEffect` for one category.

    Args:
        outcomes: Outcomes of one category.
        swapped: Name of the condition that is compared with the clean one.
        reach: Reach of the policy.
    """
    clean, other = (outcomes.correct_sign * outcomes.of(name) for name in (CLEAN, swapped))
    responses = swap_responses(outcomes, swapped)
    net = responses.astype(float)
    displacement = clean - other
    shares = displacement / reach.metres
    exchange = outcomes.exchange(swapped)
    assert exchange is not None
    follow_p, reversal_p = exchange.p_values
    reached = {}
    for side in ("left", "right"):
        near, far = (values[outcomes.sides == side] > REACHED * reach.metres for values in (clean, other))
        # By how much more often the side of the correct picture is reached; 0 where it never lies there.
        reached[f"{side}_reached"] = float(near.mean() - far.mean()) if near.size else 0.0
    return {
        **outcomes.counts,
        "follow_rate": float((responses == FOLLOWS).mean()),
        "reversal_rate": float((responses == REVERSES).mean()),
        "net_follow_rate": float(net.mean()),
        "net_follow_rate_ci": net_interval(net, outcomes),
        "follow_p": follow_p,
        "reversal_p": reversal_p,
        "median_displacement": float(np.median(np.abs(displacement))),
        "reach": reach.metres,
        "reach_source": reach.source,
        "reach_share": float(shares.mean()),
        "reach_share_ci": unbounded_student_interval(shares, outcomes.groups),
        "moved_share": float(np.abs(shares).mean()),
        **reached,
    }


def swap_responses(outcomes: ConditionOutcomes, swapped: str = IMAGE_SWAP) -> NDArray[np.int8]:
    """Return (E,) `FOLLOWS` for actions to the correct picture in both layouts, `REVERSES` or 0."""
    clean, other = (np.sign(outcomes.correct_sign * outcomes.of(name)) for name in (CLEAN, swapped))
    return np.asarray(np.where(clean * other < 0, clean, 0), np.int8)


def swap_responses_by_episode(run: RunReader) -> dict[str, int]:
    """Return by episode id how its action responds in the image swap that tables read; empty without a stored one.

    Raises:
        RunDamagedError: If a stored intervention was changed.
    """
    stored = [result.outcomes for result in preferred_by_category(run, NAME).values()]
    return {
        str(name): int(response)
        for outcomes in stored
        for name, response in zip(outcomes.episodes, swap_responses(outcomes), strict=True)
    }


def stored_image_swaps(run: RunReader, readout: str | None = None) -> dict[str, ImageSwapEffect]:
    """Return by category the effects of the image swaps that are stored for the episodes the run has now.

    Of several image swaps it is the preferred one, see `stored`. Empty if there is none.

    Args:
        run: Run with the stored interventions.
        readout: Readout of the image swaps, `first-chunk` or `per-step`; None for any.

    Raises:
        RunDamagedError: If any stored intervention was changed.
    """
    preferred = preferred_by_category(run, NAME, readout)
    stored = {result.stored.key: result.stored for result in preferred.values()}
    rows = {key: {row.category: row for row in image_swap_effects(measured)} for key, measured in stored.items()}
    return {category: rows[result.stored.key][category] for category, result in preferred.items()}


# -- the kind ------------------------------------------------------------------------------------------------


SWAP_COLUMNS = (
    EffectColumn[ImageSwapEffect](
        "moved [95 %]",
        lambda row: signed_interval(row.reach_share, row.reach_share_ci),
        "moved: displacement toward the correct picture, as a share of the policy's own reach; less than "
        f"{SMALLEST_SHARE_OF_INTEREST} does not matter",
    ),
    EffectColumn[ImageSwapEffect](
        "follow %",
        lambda row: rate(row.follow_rate),
        "follow: goes to the correct picture, and to the other side once the two are swapped",
    ),
    EffectColumn[ImageSwapEffect]("reversal %", lambda row: rate(row.reversal_rate), "reversal: the reverse"),
    EffectColumn[ImageSwapEffect](
        "net [95 %]",
        lambda row: signed_interval(row.net_follow_rate, row.net_follow_rate_ci),
        f"net: follow minus reversal, as a share; less than {SMALLEST_EFFECT_OF_INTEREST} does not matter",
    ),
    EffectColumn[ImageSwapEffect](
        "p",
        lambda row: p_of(row.follow_p, row.is_resolved),
        "p: exact; the larger of the tests by item and by group",
    ),
    EffectColumn[ImageSwapEffect]("median displacement cm", lambda row: centimetres(row.median_displacement)),
    EffectColumn[ImageSwapEffect]("n (items)", lambda row: TableCell(row.n_episodes, after=f" ({row.n_items})")),
)
"""The columns of all swaps."""


@dataclass(frozen=True, kw_only=True)
class Swap(Intervention):
    """An exchange of one input, in the condition `swapped`; a kind defines it for the scene.

    Without sides, the input is exchanged for that of a donor, and one row per category has the effect.
    """

    swapped: ClassVar[str]
    needs: ClassVar[tuple[InterventionKind, ...]] = ("swap",)

    @classmethod
    def effects(cls, measurement: Measurement) -> Sequence[Effect]:
        """Return one row per category."""
        vary = str(measurement.settings.get("vary", ""))
        return measurement.rows(lambda part: [input_effect(part, cls.swapped, vary)])

    @classmethod
    def table(cls, rows: Sequence[Any], context: Measurement) -> "Table":
        """Return one line per category and input."""
        title = f"Does the input decide? {context.subject}, {context.exchange}"
        lines = lines_of(rows, lambda row: str(row.vary))
        parts = {"Does the action follow it?": _INPUT_COLUMNS}
        return effect_table(title, ("category", "input"), lines, parts)

    @classmethod
    def sentences(cls, rows: Sequence[Any], context: Measurement) -> list[str]:
        """Return one sentence per category."""
        if not context.is_scene:
            return [f"{row.n_episodes} frames of {row.n_items} episodes: {_describe_input(row)}." for row in rows]
        return [
            f"{category_of(row.category).title} ({plural(row.n_items, 'item')}): {cls.describe(row, context)}"
            for row in rows
        ]

    @classmethod
    @abstractmethod
    def describe(cls, row: Any, context: Measurement) -> str:
        """Return the end of the sentence about a category in the scene."""

    @classmethod
    def finding(cls, rows: Sequence[Any], context: Measurement) -> str:
        """Return the verdict of one category."""
        del context
        (row,) = rows
        return _find_input(row)


@dataclass(frozen=True, kw_only=True)
class ImageSwap(Swap):
    """Two inferences per episode, same state and noise: clean, and with the two images swapped."""

    kind: ClassVar[str] = NAME
    summary: ClassVar[str] = "Swap the two images: does the action change sides?"
    position: ClassVar[int] = 1
    has_verdict: ClassVar[bool] = True
    swapped: ClassVar[str] = IMAGE_SWAP

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return clean, and with swapped images; without sides also the donor's inputs, the control and a seed."""
        unpaired = () if session.run.source.is_scene else (DONOR_RUN, CONTROL_RUN, NOISE_RUN)
        return CLEAN_RUN, SOURCE_RUN, *unpaired

    @classmethod
    def effects(cls, measurement: Measurement) -> Sequence[Effect]:
        """Return one row per category."""
        if not measurement.outcomes.is_scene:
            return super().effects(measurement)
        return image_swap_effects(measurement)

    @classmethod
    def table(cls, rows: Sequence[Any], context: Measurement) -> "Table":
        """Return one line per category with its verdict."""
        if not context.is_scene:
            return super().table(rows, context)
        verdicts = context.verdicts
        reaches = [_REACH[row.reach_source].format(100 * row.reach) for row in rows]

        def verdict(row: ImageSwapEffect) -> TableCell:
            return TableCell(verdicts[row.category].verdict if row.category in verdicts else None)

        parts = {
            "Verdict": [EffectColumn("verdict", verdict)],
            "Does the action follow the images?": SWAP_COLUMNS,
        }
        lines = [((row.category,), row) for row in rows]
        title = f"Is it used? {context.subject}, images swapped"
        return effect_table(title, ("category",), lines, parts, after=dict.fromkeys((context.legend, *reaches)))

    @classmethod
    def describe(cls, row: ImageSwapEffect, context: Measurement) -> str:
        """Return the verdict with its numbers."""
        verdict = context.verdicts.get(row.category)
        return swap_rates(row, "images") if verdict is None else str(verdict.describe(row))

    @classmethod
    def finding(cls, rows: Sequence[Any], context: Measurement) -> str:
        """Return the verdict, and how often a swap turns the action."""
        if not context.is_scene:
            return super().finding(rows, context)
        (row,) = rows
        turned = f"a swap turns it in {100 * row.follow_rate:.0f} % of the episodes"
        use = context.verdicts.get(row.category)
        verdict, what = ("swapped", "") if use is None else use.finding
        return f"{verdict}: {'; '.join(filter(None, (what, turned)))}"

    @staticmethod
    def keys_in_use(run: RunReader) -> set[str]:
        """Return keys of the image swaps that verdicts and tables read, of either readout."""
        return {row.key for readout in get_args(Readout) for row in stored_image_swaps(run, readout).values()}


KIND = ImageSwap


def swap_rates(row: ImageSwapEffect, inputs: str) -> str:
    """Return how often the action follows a swap of some inputs, as the end of a sentence."""
    low, high = (f"{100 * limit:.0f}" for limit in row.net_follow_rate_ci)
    return (
        f"the action follows a swap of the {inputs} in {100 * row.follow_rate:.0f} % of episodes and does the "
        f"reverse in {100 * row.reversal_rate:.0f} % (net {low} to {high} %)."
    )
