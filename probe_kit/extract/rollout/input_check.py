"""The input check of a certificate: does another picture, or another instruction, change the first output at all?

It decides only that an input is dead: one inference cannot show that a model uses it. `probe-kit diagnose` does.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import IgnoredInputsError, InstructionError
from probe_kit.extract.sources.inputs import INSTRUCTION, PICTURE, blank_of, same_input, with_input
from probe_kit.hooks.contract.observation import Observation

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks import Model, Site

Reach = Literal["output", "last layer", "nothing", "not the output", "not tested"]
"""The last thing on the way to the output that changed with an input; "not the output" where no layer was read."""
MOST_TEXTS = 32
"""Other instructions that are searched for one with as many tokens; each of them is tokenised."""
Ids = Callable[[str], tuple[int, ...] | None]


def check_inputs[Question](
    model: "Model",
    infer: Callable[[Question], NDArray[np.float32]],
    clean: Question,
    variants: Mapping[str, Iterable[Question]],
    last: "Site | None",
    around: Callable[[Question], AbstractContextManager[None]],
) -> dict[str, Reach]:
    """Return, by input, how far a change of it came.

    infer: one inference, always with the same seed. variants: by input, observations or prompts that differ from
    the clean one in it alone; the first that the model takes is used, and none leaves the input untested.
    last: the last residual before the output; None where no site may be captured. around: what the run does to
    the model at every inference.
    """
    if not variants:
        return {}

    def infer_as_run(question: Question) -> NDArray[np.float32]:
        with around(question):
            return infer(question)

    def residual(site: "Site", question: Question) -> "Tensor":
        from probe_kit.hooks import capture

        # The capture is entered last, so that it reads what edits left.
        with around(question), capture(model, [site]) as cache:
            infer(question)
        return cache[site]

    output = infer_as_run(clean)
    layer = None if last is None else partial(residual, last)
    return {name: _reach(infer_as_run, layer, clean, output, changed) for name, changed in variants.items()}


def _reach[Question](
    infer: Callable[[Question], NDArray[np.float32]],
    residual: "Callable[[Question], Tensor] | None",
    clean: Question,
    output: NDArray[np.float32],
    variants: Iterable[Question],
) -> Reach:
    for variant in variants:
        try:
            changed = infer(variant)
        except InstructionError:  # the model cannot take this one in; the next may do
            continue
        if not np.array_equal(changed, output, equal_nan=True):
            return "output"
        if residual is None:
            return "not the output"
        # Actions that are chosen among bins stay the same under small changes; the layer before them does not.
        return "nothing" if _same(residual(clean), residual(variant)) else "last layer"
    return "not tested"


def _same(first: "Tensor", second: "Tensor") -> bool:
    return first.shape == second.shape and bool((first == second).all())


def varied(
    clean: Observation, texts: Iterable[str], ids: Ids, absent: Collection[str] = ()
) -> dict[str, Iterator[Observation]]:
    """Return, by input, observations that differ from a clean one in it alone, the best first.

    texts: other instructions. ids: the tokens of a text, None if unknown. absent: inputs that the model has not.
    """
    variants = {PICTURE: _without_picture(clean), INSTRUCTION: _with_other_words(clean, texts, ids)}
    return {name: observations for name, observations in variants.items() if name not in absent}


def _without_picture(clean: Observation) -> Iterator[Observation]:
    blank = with_input(clean, PICTURE, blank_of([clean]))
    # A picture of one colour is its own blank: then nothing would change, and no input could be called dead.
    if not same_input(clean, blank, PICTURE):
        yield blank


def _with_other_words(clean: Observation, texts: Iterable[str], ids: Ids) -> Iterator[Observation]:
    """Other instructions, then the words in reverse; those of as many tokens first.

    A model that reads no word still notices how many there are.
    """
    words = clean.instruction
    candidates = dict.fromkeys([*islice(texts, MOST_TEXTS), " ".join(reversed(words.split()))])
    candidates.pop(words, None)
    length = _length(words, ids)
    for text in sorted(candidates, key=lambda text: _length(text, ids) != length):
        yield replace(clean, instruction=text)


def _length(text: str, ids: Ids) -> int | None:
    try:
        tokens = ids(text)
    except InstructionError:
        return None
    return None if tokens is None else len(tokens)


def check_not_ignored(reaches: Mapping[str, Reach], model: str) -> None:
    """Raise IgnoredInputsError if inputs were tested and none of them changes anything that was read."""
    tested = [name for name, reach in reaches.items() if reach != "not tested"]
    # One dead input is a finding, which the certificate keeps; only where none arrives a run would be void.
    if len(tested) > 1 and all(reaches[name] in ("nothing", "not the output") for name in tested):
        layer = ", nor of its last layer" if "nothing" in reaches.values() else ""
        raise IgnoredInputsError(
            f"another {' and another '.join(tested)} changed no number of the first output of {model}{layer}; "
            "expected at least one of them to. `probe-kit diagnose` takes the same settings and says "
            "where they are lost. --accept-ignored-inputs extracts it nevertheless"
        )
