"""Instruction swap: with the same images and the other picture asked for, does the action change sides?

If the action follows a swap of the images, the policy reads images; if it follows the instruction, it reads words.
It may follow one and not the other: a policy can have learnt what to look for, whatever is asked.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from probe_kit.errors import UsageError
from probe_kit.intervene.kinds.base import EffectColumn, centimetres, effect_table, rate
from probe_kit.intervene.kinds.image_swap import (
    SWAP_COLUMNS,
    ImageSwapEffect,
    Reach,
    Swap,
    swap_columns,
    swap_rates,
)
from probe_kit.intervene.outcomes import CLEAN, IMAGE_SWAP, INSTRUCTION_SWAP, NOISE, ConditionOutcomes, Effect
from probe_kit.intervene.replay import (
    CLEAN_RUN,
    CONTROL_RUN,
    DONOR_RUN,
    NOISE_RUN,
    SOURCE_RUN,
    Condition,
    ConditionContext,
    ConditionResult,
)
from probe_kit.intervene.stored import Measurement
from probe_kit.statistics.significance import SIGNIFICANCE

if TYPE_CHECKING:
    from probe_kit._tables.table import Table
    from probe_kit.intervene.sessions import ReplaySession

_CONDITIONS = {"instruction": INSTRUCTION_SWAP, "images": IMAGE_SWAP, "noise": NOISE}
_FOLLOW = (
    "follow: goes to the correct picture, and to the other one with the counterpart's instruction and the same "
    "images, state and noise"
)
_ONE_STEP = (
    "one step: how far apart two actions bring the hand sideways, the median over episodes; and the share of "
    "episodes in which any number of the action changed. Noise: the same with newly drawn noise, for comparison"
)


@dataclass(frozen=True)
class InputSensitivity:
    """The changes of the first inferences of one category; one input is swapped, the others stay.

    Attributes:
        instruction: Median lateral metres between the two actions' ends of the hand, with the instruction swapped.
        images: The same with the images swapped.
        noise: The same with the noise drawn anew.
        instruction_changed: Share of episodes in which any number of the action changed at all with the
            instruction swapped; 0 means that the policy ignores it.
        images_changed: The same share with the images swapped.
    """

    instruction: float
    images: float
    noise: float
    instruction_changed: float
    images_changed: float


@dataclass(frozen=True, kw_only=True)
class InstructionSwapEffect(ImageSwapEffect):
    """The columns of `ImageSwapEffect`, for the swapped instruction.

    Attributes:
        sensitivity: Sensitivity of one step to each input.
    """

    sensitivity: InputSensitivity

    def to_json(self) -> dict[str, Any]:
        """Return plain values, with the sensitivity's among them."""
        plain = asdict(self)
        return {**{name: value for name, value in plain.items() if name != "sensitivity"}, **plain["sensitivity"]}


def input_sensitivity(outcomes: ConditionOutcomes) -> InputSensitivity:
    """Return the sensitivity in the episodes of one category."""
    clean = outcomes.of(CLEAN)
    apart = {name: float(np.median(np.abs(outcomes.of(other) - clean))) for name, other in _CONDITIONS.items()}
    changed = {
        f"{name}_changed": float(
            (outcomes.max_action_change[outcomes.conditions.index(_CONDITIONS[name])] > 0).mean()
        )
        for name in ("instruction", "images")
    }
    return InputSensitivity(**apart, **changed)


def _ask_for_the_other(context: ConditionContext) -> ConditionResult:
    """Infer with the same state, noise and pictures, asked for the other picture."""
    observation = context.session.with_other_instruction(context.pair)
    assert observation is not None, "items without a counterpart are skipped"
    return ConditionResult(context.session.act(observation, context.pair.seed))


@dataclass(frozen=True, kw_only=True)
class InstructionSwap(Swap):
    """Four inferences per episode: clean, other instruction, swapped images, other noise.

    A counterpart shows the same two pictures and asks for the other one; items without one are skipped and
    counted. The last two inferences are for comparison: the sensitivity of one step's action to images and to
    noise.
    """

    kind: ClassVar[str] = "instruction-swap"
    summary: ClassVar[str] = "Ask for the other picture: does the action change sides?"
    position: ClassVar[int] = 2
    usual_vary: ClassVar[str] = "instruction"
    swapped: ClassVar[str] = INSTRUCTION_SWAP

    def eligible_items(self, session: "ReplaySession", items: Sequence[str]) -> list[str]:
        """Return those of `items` with a counterpart in the run's wording.

        Raises:
            UsageError: If there is none.
        """
        eligible = [item for item in items if session.has_other_instruction(item)]
        if not eligible:
            raise UsageError(
                f"none of the {len(items)} items has a counterpart in its suite: the same two pictures, asked for "
                "the other one. Suites of `probe-kit suite build` have them; else swap images (--kind image-swap)"
            )
        return eligible

    def conditions(self, session: "ReplaySession") -> Sequence[Condition]:
        """Return clean, the other picture's instruction, swapped images, and noise drawn anew.

        Without sides, the images are those of a donor, and a control is added.
        """
        swapped = Condition(INSTRUCTION_SWAP, _ask_for_the_other)
        if session.run.source.is_scene:
            return CLEAN_RUN, swapped, SOURCE_RUN, NOISE_RUN
        return CLEAN_RUN, swapped, DONOR_RUN, CONTROL_RUN, NOISE_RUN

    @classmethod
    def effects(cls, measurement: Measurement) -> Sequence[Effect]:
        """Return one row per category, in the order of the episodes."""
        if not measurement.outcomes.is_scene:
            return super().effects(measurement)
        reach = Reach.of(measurement.outcomes.of(CLEAN), measurement.tiles_apart)

        def category_effects(part: ConditionOutcomes) -> list[InstructionSwapEffect]:
            columns = swap_columns(part, INSTRUCTION_SWAP, reach)
            sensitivity = input_sensitivity(part)
            return [InstructionSwapEffect(**columns, readout=measurement.readout, sensitivity=sensitivity)]

        return measurement.rows(category_effects)

    @classmethod
    def table(cls, rows: Sequence[Any], context: Measurement) -> "Table":
        """Return one line per category with the sensitivity of one step."""
        if not context.is_scene:
            return super().table(rows, context)
        swap = [replace(each, term=_FOLLOW if each.heading == "follow %" else "") for each in SWAP_COLUMNS]
        parts = {"Does the action follow the instruction?": swap, "What changes one step": _STEP_COLUMNS}
        lines = [((row.category,), row) for row in rows]
        title = f"Is the instruction read? {context.subject}"
        return effect_table(title, ("category",), lines, parts, after=[_ONE_STEP])

    @classmethod
    def describe(cls, row: InstructionSwapEffect, context: Measurement) -> str:
        """Return the rates; a swap of the instruction enters no verdict."""
        del context
        return swap_rates(row, "instruction")

    @classmethod
    def finding(cls, rows: Sequence[Any], context: Measurement) -> str:
        """Return whether the action follows a swap of the instruction."""
        if not context.is_scene:
            return super().finding(rows, context)
        (row,) = rows
        follows = "followed" if row.is_resolved and row.follow_p < SIGNIFICANCE else "not shown"
        verdict = "reversed" if row.is_resolved and row.reversal_p < SIGNIFICANCE else follows
        return (
            f"{verdict}: another instruction turns the action to its own picture in "
            f"{100 * row.follow_rate:.0f} % of the episodes, and away from it in {100 * row.reversal_rate:.0f} %"
        )


KIND = InstructionSwap
_STEP_COLUMNS = [
    EffectColumn[Any]("instruction cm", lambda row: centimetres(row.sensitivity.instruction)),
    EffectColumn[Any]("images cm", lambda row: centimetres(row.sensitivity.images)),
    EffectColumn[Any]("noise cm", lambda row: centimetres(row.sensitivity.noise)),
    EffectColumn[Any]("instruction changes it %", lambda row: rate(row.sensitivity.instruction_changed)),
    EffectColumn[Any]("images change it %", lambda row: rate(row.sensitivity.images_changed)),
]
