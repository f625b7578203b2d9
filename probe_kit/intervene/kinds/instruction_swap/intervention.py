"""Instruction swap: asked for the other picture before the same images, does the action change sides?

Following the images shows that they are read; following the instruction shows that it is read. A policy may do one
and not the other: it can have learnt what to look for, whatever is asked.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.intervene.replay.conditions import (
    CleanRun,
    Condition,
    ConditionContext,
    ConditionResult,
    ImagesSwapped,
    Intervention,
)
from probe_kit.intervene.replay.session import ReplaySession
from probe_kit.intervene.store.answers import INSTRUCTION_SWAP, NOISE
from probe_kit.suite.items import Episode, Layout
from probe_kit.suite.ladder import check_wordings, in_words

_TURNED: Mapping[Layout, Layout] = {"original": "swapped", "swapped": "original"}


@dataclass(frozen=True, kw_only=True)
class InstructionSwap(Intervention):
    """Four inferences per episode: clean, other instruction, swapped images, other noise.

    A counterpart shows the same two pictures and asks for the other one; items without one are skipped and
    counted. The last two are for comparison: the sensitivity of one step's action to images and to noise.
    """

    @property
    def kind(self) -> str:
        """`words`."""
        return "instruction-swap"

    @property
    def required_capabilities(self) -> tuple[InterventionKind, ...]:
        """Two inferences that can be compared."""
        return ("swap",)

    def eligible_items(self, session: ReplaySession, items: Sequence[str]) -> list[str]:
        """Those of `items` with a counterpart in the run's wording. Raises UsageError if there is none."""
        found = [item for item in items if counterpart_instruction(session, item, "original") is not None]
        if not found:
            raise UsageError(
                f"none of the {len(items)} items has a counterpart in its suite: the same two pictures, asked for "
                "the other one. Suites of `probe-kit suite build` have them; else swap images (--kind image-swap)"
            )
        return found

    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """As the run made it; asked for the other picture; the images swapped; the noise drawn anew."""
        del session
        return CleanRun(), InstructionSwapped(), ImagesSwapped(), NoiseResampled()


@dataclass(frozen=True)
class InstructionSwapped:
    """The same state, noise and pictures, asked for the other one of the two."""

    name: str = INSTRUCTION_SWAP

    def play(self, context: ConditionContext) -> ConditionResult:
        """Only what is asked is another."""
        replay_input = context.replay_input
        words = counterpart_instruction(context.session, replay_input.item_id, replay_input.layout)
        assert words is not None, "items without a counterpart are skipped"
        return ConditionResult(
            context.session.act(replace(replay_input.seen, instruction=words), replay_input.seed)
        )


@dataclass(frozen=True)
class NoiseResampled:
    """The same question with its noise drawn anew; the same action again where a policy draws none."""

    name: str = NOISE

    def play(self, context: ConditionContext) -> ConditionResult:
        """Only the seed is another."""
        replay_input = context.replay_input
        return ConditionResult(context.session.act(replay_input.seen, derive_seed(replay_input.seed, NOISE, 0)))


def counterpart_instruction(session: ReplaySession, item_id: str, layout: Layout) -> str | None:
    """The counterpart's instruction in the run's wording, its pictures lying as the item's do in `layout`."""
    counterpart = session.counterparts.get(item_id)
    if counterpart is None:
        return None
    if session.run.wording is None:
        return counterpart.instruction
    own = session.items[item_id]
    alike = own.left_pixels_sha256 == counterpart.left_pixels_sha256
    (wording,) = check_wordings([session.run.wording])
    intervention = in_words(Episode(counterpart, layout if alike else _TURNED[layout]), wording)
    return None if intervention is None else intervention.item.instruction
