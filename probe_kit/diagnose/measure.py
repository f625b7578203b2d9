"""The inferences of a diagnosis: unchanged, with each input exchanged, blanked, and changed without meaning."""

from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.diagnose.importance import ActionScale, Exchanges, compare_with_base, importance_of
from probe_kit.diagnose.inputs import controls_of, inputs_of, spread_of_states
from probe_kit.diagnose.results import InputDiagnosis, check_names
from probe_kit.errors import InstructionError, UsageError
from probe_kit.extract.sources.inputs import (
    BEYOND,
    GIVE_WORDS,
    INSTRUCTION,
    STATE,
    Frame,
    InputComparison,
    blank_of,
    content_of,
    describe_spellings,
    draw_donors,
    with_input,
)
from probe_kit.hashing import derive_seed

if TYPE_CHECKING:
    from probe_kit.hooks.contract.observation import Observation

DONORS = 6
"""Donors of each frame. One alone often asks for the same action by chance; inferences grow with their number.

With six, and 24 frames, no verdict on the organisms of `docs/notes/causal.md` is wrong.
"""
Actions = NDArray[np.float32]
Infer = Callable[[Sequence["Observation"], Sequence[int]], Actions]
"""A function from observations and seeds to actions (B, chunk, D), in any unit; deterministic for a seed."""


def count_inferences(
    frames: int, inputs: int, sites: int = 0, base: bool = False, pairs: int | None = None
) -> int:
    """Return how many inferences a diagnosis takes at most.

    Args:
        frames: Number of frames.
        inputs: Number of inputs that are exchanged.
        sites: Number of sites that are patched, 0 for none.
        base: Whether a base checkpoint is compared.
        pairs: Number of pairs of a table; None for donors that are drawn.
    """
    checkpoints, pairs = 1 + base, frames * DONORS if pairs is None else pairs
    # Clean ones twice and with another seed; per input the donors' value, all of their inputs, control and blank.
    measured = (3 * frames + inputs * (2 * pairs + 2 * frames)) * checkpoints
    # Of patched sites, per frame and input: clean and donor, and one per site.
    return measured + (frames * inputs * (2 + sites) if sites else 0)


@dataclass(frozen=True)
class InputExchange:
    """Exchanges of inputs between frames, and the changes that they cause.

    Attributes:
        infer: Infers with the policy that is diagnosed.
        frames: The frames between which inputs are exchanged.
        seed: Seed of the draw of donors.
        table: Pairs (frame, donor) of the user's own in order; empty for drawn ones.
        words: Further instructions that donors hold, beside those of the frames.
    """

    infer: Infer
    frames: Sequence[Frame]
    seed: int = 0
    table: Sequence[tuple[int, int]] = ()
    words: Sequence[str] = ()
    _exchanges: dict[str, Exchanges] = field(default_factory=dict, repr=False)
    _comparisons: dict[str, InputComparison] = field(default_factory=dict, repr=False)

    def measure(
        self, names: Sequence[str] = (), *, absent: Collection[str] = (), camera: str = ""
    ) -> tuple[InputDiagnosis, ...]:
        """Return how much of the action every input decides.

        Args:
            names: Names of the inputs; empty for all.
            absent: Inputs that the model declares never to read, such as `Model.absent_inputs`.
            camera: The name of the first camera.

        Raises:
            UsageError: For an unknown name, fewer than two groups, or a policy that gives other actions for the
                same observation and seed.
        """
        available = inputs_of(self.frames, camera)
        check_names(names, available)
        measured = map(self._measure, names or available)
        return tuple(
            _apply_declaration(diagnosed) if diagnosed.name in absent else diagnosed for diagnosed in measured
        )

    def against(self, base: Infer, inputs: Sequence[InputDiagnosis]) -> tuple[InputDiagnosis, ...]:
        """Return the inputs, the exchanged ones with their comparison with a base checkpoint; raises as `measure`.

        Args:
            base: Infers with the base checkpoint.
            inputs: Results of `measure` of this object.
        """
        other = InputExchange(base, self.frames, self.seed, self.table, self.words)
        compared = []
        for diagnosed in inputs:
            comparison = None
            if diagnosed.matters is not None:
                of_base = other._measure(diagnosed.name)
                exchanges = self._exchanges[diagnosed.name], other._exchanges[diagnosed.name]
                comparison = compare_with_base(diagnosed, of_base, *exchanges)
            compared.append(replace(diagnosed, base=comparison))
        return tuple(compared)

    def donors(self, name: str) -> list[tuple[int, int]]:
        """Return the pairs (frame, donor) of an input: from the table, or drawn by `draw_donors`.

        Every call returns the same pairs. Donors of a frame hold different values of the input, as far as there
        are so many. A donor is an index of `candidates`.
        """
        compared, candidates = self._compare_values(name), self.candidates(name)
        if self.table:
            return [(index, donor) for index, donor in self.table if compared.differ(index, donor)]
        values = compared.values(len(candidates))
        # A seed per input, so that the donors of one do not depend on which others are measured.
        rng, pairs = np.random.default_rng(derive_seed(self.seed, "donors", name)), []
        drawn = draw_donors(candidates, name, rng, len(candidates), range(len(self.frames)), compared)
        for index, of_frame in groupby(drawn, key=itemgetter(0)):
            donors = [donor for _, donor in of_frame]
            distinct = [donors[at] for at in np.sort(np.unique(values[donors], return_index=True)[1])]
            repeated = [donor for donor in donors if donor not in distinct]
            pairs += [(index, donor) for donor in [*distinct, *repeated][:DONORS]]
        return pairs

    def candidates(self, name: str) -> Sequence[Frame]:
        """Return the frames among which donors are drawn: all, and of the instruction those with other words."""
        if name != INSTRUCTION or not self.words:
            return self.frames
        return self._with_words

    @cached_property
    def _with_words(self) -> Sequence[Frame]:
        return [*self.frames, *(frame.with_instruction(text) for text in self.words for frame in self.frames)]

    def first_donors(self, name: str) -> list[tuple[int, int]]:
        """Return one donor per frame of an input, of those that `donors` draws."""
        return list(dict(reversed(self.donors(name))).items())  # of a key named twice, a dict keeps the last value

    @cached_property
    def clean(self) -> Actions:
        """The actions of all frames.

        Raises:
            UsageError: Unless a second inference gives the same actions.
        """
        actions, again = (self.infer(self.observations, self._seeds) for _ in range(2))
        if not np.array_equal(actions, again):
            raise UsageError(
                "the same observations and seeds gave actions that differ by "
                f"{np.abs(actions - again).max():.3g}; expected none. An effect of an "
                "input would not differ from chance in this policy"
            )
        return actions

    @cached_property
    def scale(self) -> ActionScale:
        """The spread of clean actions over frames and seeds.

        Raises:
            UsageError: If all actions are equal.
        """
        scale = ActionScale.of(np.concatenate([self.clean, self._with_other_seeds]))
        if not scale.varies.any():
            raise UsageError(
                f"all {2 * len(self.frames)} actions are equal, whatever is seen; give frames that differ"
            )
        return scale

    @cached_property
    def _with_other_seeds(self) -> Actions:
        return self.infer(self.observations, [derive_seed(seed, "other") for seed in self._seeds])

    @cached_property
    def _blank(self) -> "Observation":
        return blank_of(self.observations)

    @cached_property
    def _spread(self) -> NDArray[np.float64]:
        return spread_of_states(self.frames)

    @cached_property
    def observations(self) -> "list[Observation]":
        """The observations of all frames, read once."""
        return [frame.observation for frame in self.frames]

    @property
    def _seeds(self) -> list[int]:
        return [frame.seed for frame in self.frames]

    def _compare_values(self, name: str) -> InputComparison:
        if name not in self._comparisons:
            self._comparisons[name] = InputComparison.of(self.candidates(name), name)
        return self._comparisons[name]

    def _why_not_varied(self, name: str) -> str:
        """Return why no pair differs in an input, and what to do."""
        frames = self.frames
        values = self._compare_values(name).values(len(frames))
        if np.unique(values).size > 1:
            of = "pair of the table holds" if self.table else "two groups of frames hold"
            return f"no {of} different values"
        if name != INSTRUCTION:
            exact = len({content_of(observation, name) for observation in self.observations}) == 1
            than = "moves it" if name == STATE else "changes it"
            near = "" if exact else f": they differ by less than {BEYOND:g} times what the control {than}"
            return f"all {len(frames)} frames hold one value{near}"
        spelt = "; ".join(describe_spellings(frame.instruction for frame in frames))
        return f"all {len(frames)} frames hold one value{f': {spelt}' if spelt else ''}. {GIVE_WORDS}"

    def _measure(self, name: str) -> InputDiagnosis:
        frames, observations, clean, scale = self.frames, self.observations, self.clean, self.scale
        pairs = self.donors(name)
        if not pairs:
            return InputDiagnosis(name, "not varied", self._why_not_varied(name))
        rows = np.array([index for index, _ in pairs])
        seeds = [frames[index].seed for index in rows]
        candidates = self.candidates(name)
        values = self._compare_values(name).values(len(candidates))
        donors = [candidates[donor].observation for _, donor in pairs]
        varied = [with_input(observations[index], name, donor) for index, donor in zip(rows, donors, strict=True)]
        exchanged, every = self.infer(varied, seeds), self.infer(donors, seeds)
        control = self._infer_control(name)
        blanked = self._infer_blank(name)
        self._exchanges[name] = Exchanges(
            exchanged=scale.shares(exchanged, clean[rows]),
            control=None if control is None else scale.shares(control, clean)[rows],
            every=scale.shares(every, clean[rows]),
            groups=np.array([frames[index].group for index in rows]),
            frames=rows,
            repeated=_is_repeated(rows, values[[donor for _, donor in pairs]]),
            largest=np.abs(exchanged - clean[rows]).max(axis=(1, 2)),
            blanked=np.abs(blanked - clean[: len(blanked)]).max(axis=(1, 2), initial=0.0),
            seeded=scale.shares(self._with_other_seeds, clean)[rows],
        )
        return importance_of(name, self._exchanges[name])

    def _infer_control(self, name: str) -> Actions | None:
        """Return the actions of all frames after a change without meaning.

        None where the model takes no such change of some frame.
        """
        chunks = []
        for frame in self.frames:
            for control in controls_of(frame, name, self._spread):
                with suppress(InstructionError):
                    chunks.append(self.infer([control], [frame.seed])[0])
                    break
            else:
                return None
        return np.stack(chunks)

    def _infer_blank(self, name: str) -> Actions:
        """Return the actions of all frames without one input; none where the family refuses text without words."""
        try:
            return self.infer(
                [with_input(observation, name, self._blank) for observation in self.observations], self._seeds
            )
        except InstructionError:
            return np.zeros((0, 1, 1), np.float32)


def _is_repeated(rows: NDArray[np.intp], values: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return whether an earlier pair of the same frame has a donor with the same value, (P,)."""
    repeated = np.ones(rows.size, bool)
    repeated[np.unique(np.stack([rows, values]), axis=1, return_index=True)[1]] = False
    return repeated


def _apply_declaration(measured: InputDiagnosis) -> InputDiagnosis:
    """Return the diagnosis of an input that the adapter declares unread: it is no input if nothing arrived.

    A measured effect counts more than the declaration.
    """
    if measured.verdict not in ("does not arrive", "not varied"):
        return measured
    return replace(measured, verdict="not an input", reason=f"the model reads no {measured.name}")
