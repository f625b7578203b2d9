"""Prompts that hold the state as digits, as lerobot words them for pi0.5 and pi0-FAST."""

import re
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.views import PADDING
from probe_kit.hooks.families.shared.lerobot.policy import LerobotPolicy

BINS = np.linspace(-1, 1, 256 + 1)[:-1]
"""Lower edges of the 256 bins of a normalised state, as lerobot's processor step of pi0.5 makes them."""
_PROMPT = re.compile(
    r"Task: ?(?P<language>.*), ?State: ?(?P<state>[-\d ]*);\s*(?:Action:\s*)?\Z", re.DOTALL | re.IGNORECASE
)
"""The prompt of pi0.5; its named parts are roles."""
_LEFT_OUT = (PADDING, "state")


def digits(state: NDArray[np.float32]) -> list[str]:
    """(B, numbers) normalised to the numbers of their bins: 0 to 255, and -1 below the range."""
    return [" ".join(map(str, row)) for row in np.digitize(state, BINS) - 1]


def label_groups(pieces: Sequence[str], pattern: re.Pattern[str]) -> list[str]:
    """A label per piece of a text: the named group of `pattern` that it has characters in, else `special`."""
    ends = np.cumsum([len(piece) for piece in pieces])
    labels = ["special"] * len(pieces)
    if (match := pattern.search("".join(pieces))) is None:
        return labels
    for role in pattern.groupindex:
        first, last = match.span(role)
        for position, (piece, end) in enumerate(zip(pieces, ends, strict=True)):
            if piece and end - len(piece) < last and end > first:
                labels[position] = role
    return labels


class StatePrompt(LerobotPolicy):
    """A lerobot policy that reads its state in its prompt."""

    other_roles: ClassVar[tuple[str, ...]] = ("language", "state", "special")
    prompt_end: ClassVar[str] = ""
    """What follows the state."""

    def prompts(self, instructions: Sequence[str], state: NDArray[np.float32]) -> list[str]:
        """Return prompts as lerobot's processor steps of these policies word them."""
        tasks = [text.strip().replace("_", " ").replace("\n", " ") for text in instructions]
        return [
            f"Task: {task}, State: {state_digits};\n{self.prompt_end}"
            for task, state_digits in zip(tasks, digits(state), strict=True)
        ]

    def text_labels(self, ids: Sequence[int], valid: Sequence[bool]) -> list[str]:
        """The instruction is `language`, the digits are `state`, and the words around them are `special`."""
        special = frozenset(self.tokenizer.all_special_ids)
        pieces = [
            "" if number in special or not is_text else piece.replace("\u2581", " ")
            for number, is_text, piece in zip(
                ids, valid, self.tokenizer.convert_ids_to_tokens(list(ids)), strict=True
            )
        ]
        labels = label_groups(pieces, _PROMPT)
        return [label if is_text else PADDING for label, is_text in zip(labels, valid, strict=True)]

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each prompt without padding and without the digits, which change at every inference."""
        tokens, mask = self.tokenise(instructions)
        rows = zip(tokens.tolist(), mask.tolist(), strict=True)
        return [
            tuple(
                number
                for number, label in zip(ids, self.text_labels(ids, valid), strict=True)
                if label not in _LEFT_OUT
            )
            for ids, valid in rows
        ]
