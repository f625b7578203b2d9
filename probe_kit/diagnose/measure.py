"""The inferences of a diagnosis: clean, with every input exchanged, blanked and hardly changed."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.diagnose.donors import draw_donors
from probe_kit.diagnose.importance import ActionScale, Exchanges, Importance, importance_of, untested
from probe_kit.diagnose.inputs import (
    Frame,
    blank_of,
    differing,
    hardly_changed,
    inputs_of,
    spread_of_states,
)
from probe_kit.errors import InstructionError, UsageError
from probe_kit.hashing import derive_seed
from probe_kit.intervene.sessions.observed import STATE, with_input

if TYPE_CHECKING:
    from probe_kit.hooks.contract.observation import Observation

Actions = NDArray[np.float32]
Infer = Callable[[Sequence["Observation"], Sequence[int]], Actions]
"""From observations and seeds to actions (B, chunk, D), in any unit; deterministic for a seed."""


def measure_inputs(
    infer: Infer,
    frames: Sequence[Frame],
    names: Sequence[str] = (),
    seed: int = 0,
    *,
    reads_state: bool = True,
    camera: str = "",
) -> tuple[Importance, ...]:
    """How much of the action every input decides.

    names: of the inputs; empty for all. seed: of the draw of donors. reads_state: whether the model is given a
    state at all. camera: the name of the first one. Raises UsageError for an unknown name, fewer than two groups,
    or a policy that gives other actions for the same observation and seed.
    """
    known = inputs_of(frames, camera)
    if unknown := [name for name in names if name not in known]:
        raise UsageError(f"no input is called {unknown[0]!r}; this source has {', '.join(known)}")
    clean = _clean(infer, frames)
    other = infer([frame.observation for frame in frames], [derive_seed(frame.seed, "other") for frame in frames])
    scale = ActionScale.of(np.concatenate([clean, other]))
    if not scale.varies.any():
        raise UsageError(f"all {2 * len(frames)} actions are equal, whatever is seen; give frames that differ")
    measured = (_measure(infer, frames, name, clean, scale, seed) for name in names or known)
    return tuple(one if reads_state else _without_state(one) for one in measured)


def _without_state(measured: Importance) -> Importance:
    """The state of a model that declares none is no input, where the measurement agrees."""
    if measured.name != STATE or measured.verdict not in ("does not arrive", "not varied"):
        return measured
    return replace(measured, verdict="not an input", reason="the model reads no state")


def _clean(infer: Infer, frames: Sequence[Frame]) -> Actions:
    """Actions of all frames. Raises UsageError unless the first are the same again."""
    observations, seeds = [frame.observation for frame in frames], [frame.seed for frame in frames]
    actions, again = infer(observations, seeds), infer(observations, seeds)
    if not np.array_equal(actions, again):
        raise UsageError(
            f"the same observations and seeds gave actions that differ by {np.abs(actions - again).max():.3g}; "
            "expected none. An effect of an input would not differ from chance in this policy"
        )
    return actions


def _measure(
    infer: Infer, frames: Sequence[Frame], name: str, clean: Actions, scale: ActionScale, seed: int
) -> Importance:
    if not differing(frames, name):
        return untested(name, "not varied", f"all {len(frames)} frames hold one value")
    pairs = draw_of(frames, name, seed)
    if not pairs:
        return untested(name, "not varied", "no two groups of frames hold different values")
    rows = np.array([index for index, _ in pairs])
    seeds = [frames[index].seed for index in rows]
    donors = [frames[donor].observation for _, donor in pairs]
    varied = [
        with_input(frames[index].observation, name, donor) for index, donor in zip(rows, donors, strict=True)
    ]
    spread, empty, frame_seeds = spread_of_states(frames), blank_of(frames), [frame.seed for frame in frames]
    exchanged = infer(varied, seeds)
    every = infer(donors, seeds)
    control = infer(
        [with_input(frame.observation, name, hardly_changed(frame, spread)) for frame in frames], frame_seeds
    )
    blanked = _blanked(infer, frames, name, empty)
    return importance_of(
        name,
        Exchanges(
            exchanged=scale.shares(exchanged, clean[rows]),
            control=scale.shares(control, clean)[rows],
            every=scale.shares(every, clean[rows]),
            groups=np.array([frames[index].group for index in rows]),
            first=np.concatenate([[True], np.diff(rows) != 0]),
            largest=np.abs(exchanged - clean[rows]).max(axis=(1, 2)),
            blanked=np.abs(blanked - clean[: len(blanked)]).max(axis=(1, 2), initial=0.0),
        ),
    )


def _blanked(infer: Infer, frames: Sequence[Frame], name: str, empty: "Observation") -> Actions:
    """Actions of all frames without one input; of none where the family refuses an instruction without words."""
    blank = [with_input(frame.observation, name, empty) for frame in frames]
    try:
        return infer(blank, [frame.seed for frame in frames])
    except InstructionError:
        return np.zeros((0, 1, 1), np.float32)


def draw_of(frames: Sequence[Frame], name: str, seed: int) -> list[tuple[int, int]]:
    """The same pairs (frame, donor) of an input for one seed, see `draw_donors`."""
    return draw_donors(frames, name, np.random.default_rng(derive_seed(seed, "donors", name)))


def in_batches(infer: Infer, size: int) -> Infer:
    """The same function, asked for `size` observations at once; a shorter rest is filled up with its last one.

    Filled up, because another size of a batch may round other sums, which would look like an effect.
    """

    def batched(observations: Sequence["Observation"], seeds: Sequence[int]) -> Actions:
        chunks = []
        for start in range(0, len(observations), size):
            given = list(zip(observations[start : start + size], seeds[start : start + size], strict=True))
            full = given + [given[-1]] * (size - len(given))
            chunks.append(infer([one for one, _ in full], [one for _, one in full])[: len(given)])
        return np.concatenate(chunks)

    return batched
