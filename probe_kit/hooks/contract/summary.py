"""A loaded model in one line and as a notebook table."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from probe_kit._terminal.notebook import facts_html

if TYPE_CHECKING:
    from probe_kit.hooks.contract.card import ModelCard
    from probe_kit.hooks.contract.sites import Stream


def layers_text(stream: "Stream", unit: str = "iterations") -> str:
    """`expert 4 layers x 10 iterations`. unit: the name of an iteration."""
    times = "" if stream.iterations in (None, 1) else f" x {stream.iterations} {unit}"
    return f"{stream.name} {stream.layers} layers{times}"


def streams_text(streams: "Iterable[Stream]") -> str:
    """All streams in one line, such as `expert 4 layers x 10 iterations x 64`; `none` if there are none."""
    return "; ".join(f"{layers_text(stream)} x {stream.width}" for stream in streams) or "none"


def parameters_text(parameters: int) -> str:
    """`0.82 million`, `3.5 billion`."""
    return f"{parameters / 1e9:.1f} billion" if parameters >= 1e9 else f"{parameters / 1e6:.2f} million"


def model_text(name: str, card: "ModelCard", streams: "Mapping[str, Stream]") -> str:
    """One line: family, size, where it runs, streams; random weights in capitals."""
    random = ", RANDOM WEIGHTS" if card.random_weights else ""
    size = f"{parameters_text(card.parameters)} parameters"
    return (
        f"<{name} {card.family}{random}: {size}, {card.dtype} on {card.device}; {streams_text(streams.values())}>"
    )


def model_html(card: "ModelCard", streams: "Mapping[str, Stream]") -> str:
    """The card's facts as a table."""
    facts = {
        "checkpoint": card.checkpoint,
        "weights": "RANDOM, untrained" if card.random_weights else f"sha256 {card.weights_sha256[:12]}",
        "parameters": parameters_text(card.parameters),
        "runs in": f"{card.dtype} on {card.device}" + ("" if card.exact else ", not exact"),
        "streams": streams_text(streams.values()),
        "actions": f"{card.chunk} per inference, {card.execute} executed" if card.chunk else "none",
        "embodiment": card.embodiment,
        "notes": "; ".join(card.notes),
    }
    return facts_html(card.family, facts)
