"""The streams of a released size, declared without its network. Imports no torch."""

from dataclasses import dataclass
from typing import Any

from probe_kit.hooks.contract.sites import Stream
from probe_kit.hooks.contract.summary import layers_text

TEXT = ("language", "special")


@dataclass(frozen=True)
class DeclaredStream:
    """A stream of a family at a released size.

    tokens: at a picture of 640 × 480 and an instruction of ten words, about; sizes of runs are estimated by it.
    roles: what its tokens can be.
    """

    stream: Stream
    tokens: int
    roles: tuple[str, ...]

    def __str__(self) -> str:
        """The stream in words: `expert 19 layers x 10 iterations`, `action 9 layers x 7 action tokens`."""
        return layers_text(self.stream, "iterations" if self.tokens > 1 else f"{self.stream.name} tokens")


def backbone(
    layers: int, width: int, tokens: int, *more: str, camera: str = "primary", sums: bool = True
) -> DeclaredStream:
    """A language model that reads one picture and text. more: roles beside those."""
    return DeclaredStream(Stream("backbone", layers, width, sums=sums), tokens, (f"image.{camera}", *TEXT, *more))


def chosen_tokens(name: str, layers: int, width: int, iterations: int, sums: bool = True) -> DeclaredStream:
    """The positions of a language model that choose its output, one per iteration."""
    return DeclaredStream(Stream(name, layers, width, iterations, part="action", sums=sums), 1, (name,))


def expert(
    layers: int, width: int, iterations: int, tokens: int, roles: tuple[str, ...], **fields: Any
) -> DeclaredStream:
    """A flow or diffusion transformer, with its tokens at every iteration. fields: those of `Stream`."""
    shape = {"name": "expert", "part": "action", **fields}
    return DeclaredStream(Stream(layers=layers, width=width, iterations=iterations, **shape), tokens, roles)


def answering(layers: int, width: int, tokens: int, sums: bool = True) -> tuple[DeclaredStream, ...]:
    """The two streams of a VLM that answers."""
    return backbone(layers, width, tokens, sums=sums), chosen_tokens("answer", layers, width, 1, sums)
