"""FAST: ids of action tokens to a chunk of actions, without the remote code of the released tokenizer.

A chunk is transformed per dimension along time (discrete cosine transform), scaled and rounded. It is flattened,
the lowest frequency of every dimension first. Each coefficient is a character; byte pairs of that text are tokens.

Source: arXiv 2501.09747; decoding as in `UniversalActionProcessor`, which lerobot ships for MolmoAct2.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import idct  # type: ignore[import-untyped]
from tokenizers import Tokenizer

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError

FILES = ("tokenizer.json", "processor_config.json")
_BROKEN = "\ufffd"
"""What bytes become that make no character."""


@dataclass(frozen=True)
class DecodedChunk:
    """values: (H, D) float64, normalised. problems: why the tokens are no whole chunk; empty where they are."""

    values: NDArray[np.float64]
    problems: tuple[str, ...]


@dataclass(frozen=True)
class FastTokenizer:
    """FAST's tokenizer. pieces: byte pairs. scale: coefficients per unit. least: the coefficient of chr(0)."""

    pieces: Any
    scale: float
    least: int

    @classmethod
    def from_folder(cls, folder: Path) -> "FastTokenizer":
        """Read `tokenizer.json` and `processor_config.json`. Raises CheckpointError."""
        lacking = [name for name in FILES if not (folder / name).is_file()]
        if lacking:
            raise CheckpointError(
                f"{folder} is no FAST tokenizer: it has no {' and no '.join(lacking)}. Download it again"
            )
        try:
            values = load_json(folder / FILES[1])
            scale, least = float(values["scale"]), int(values["min_token"])
            pieces = Tokenizer.from_file(str(folder / FILES[0]))
        except (KeyError, TypeError, ValueError, Exception) as error:  # tokenizers raises Exception itself
            raise CheckpointError(f"the FAST tokenizer in {folder} cannot be read ({error!r})") from error
        if not scale > 0:
            raise CheckpointError(f"{folder / FILES[1]} has scale {scale}; expected a positive number")
        return cls(pieces, scale, least)

    @property
    def size(self) -> int:
        """Number of its tokens."""
        return int(self.pieces.get_vocab_size())

    def decode(self, ids: Sequence[int], horizon: int, dimensions: int) -> DecodedChunk:
        """The chunk (horizon, dimensions) of its ids.

        Ids that it does not have and bytes that make no character are left out, missing coefficients are zero, and
        surplus ones are cut, as in lerobot's relaxed decoding. Each is a problem: lerobot says so only in its log.
        """
        problems = []
        fast_ids = [number for number in ids if 0 <= number < self.size]
        if len(fast_ids) < len(ids):
            problems.append(f"{len(ids) - len(fast_ids)} of {len(ids)} tokens name no FAST token")
        text = self.pieces.decode(fast_ids, skip_special_tokens=False)
        if broken := text.count(_BROKEN):
            problems.append(f"the tokens break {broken} characters apart")
        coefficients = (
            np.array([ord(character) for character in text if character != _BROKEN], np.int64) + self.least
        )
        count = horizon * dimensions
        if len(coefficients) != count:
            problems.append(f"{len(coefficients)} coefficients; a chunk has {horizon} x {dimensions}")
        filled = np.zeros(count)
        filled[: len(coefficients)] = coefficients[:count]
        values = idct(filled.reshape(horizon, dimensions) / self.scale, axis=0, norm="ortho")
        return DecodedChunk(np.asarray(values), tuple(problems))


@dataclass(frozen=True)
class ActionText:
    """The place of FAST's tokens in the network's output: behind `begin`, before `end`.

    fast: the tokenizer. last: the id of its token 0; the others lie below. begin: ids of "Action: ". end: the id
    that ends a chunk. checked: whether a row must begin with `begin`.
    """

    fast: FastTokenizer
    last: int
    begin: tuple[int, ...]
    end: int
    checked: bool = True

    @classmethod
    def of(cls, text: Any, fast: FastTokenizer, skipped: int, checked: bool) -> "ActionText":
        """Read PaliGemma's tokenizer. skipped: ids at its end that stay free. Raises CheckpointError."""
        last = int(text.vocab_size) - 1 - skipped
        if last - fast.size < 0:
            raise CheckpointError(
                f"the text tokenizer has {text.vocab_size} ids; {skipped} free ones and {fast.size} FAST tokens "
                "do not fit. Its files belong to another checkpoint"
            )
        begin = tuple(text.encode("Action: ", add_special_tokens=False))
        return cls(fast, last, begin, int(text.convert_tokens_to_ids("|")), checked)

    def ids(self, fast: Sequence[int]) -> list[int]:
        """The network's ids for FAST's tokens: "Action: ", the tokens, and the end."""
        return [*self.begin, *(self.last - number for number in fast), self.end]

    def decode(self, ids: Sequence[int], horizon: int, dimensions: int) -> DecodedChunk:
        """The chunk in one row of ids. Also a problem: another beginning, and no end."""
        tokens, problems = list(ids), []
        if self.end in tokens:
            tokens = tokens[: tokens.index(self.end)]
        else:
            problems.append(f"no end of the actions in {len(tokens)} tokens")
        if self.checked and tuple(tokens[: len(self.begin)]) != self.begin:
            problems.append('the tokens do not begin with "Action: "')
        chunk = self.fast.decode(
            [self.last - number for number in self._without_begin(tokens)], horizon, dimensions
        )
        return DecodedChunk(chunk.values, (*problems, *chunk.problems))

    def _without_begin(self, ids: Sequence[int]) -> list[int]:
        """Every "Action: " is left out, as lerobot does it."""
        remaining, at, length = [], 0, len(self.begin)
        while at < len(ids):
            if tuple(ids[at : at + length]) == self.begin:
                at += length
            else:
                remaining.append(ids[at])
                at += 1
        return remaining
