"""Interventions that a family supports, declared as data and readable before loading. Imports no torch."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, get_args

from probe_kit.errors import UnsupportedInterventionError, UsageError

InterventionKind = Literal["swap", "edit", "kv", "attention", "tiles", "gradients"]
Readout = Literal["first-chunk", "per-step"]
"""first-chunk: lateral displacement by the first inference's actions, none of them executed.
per-step: its sum over every inference of the unedited episode; only the clean actions are executed."""
ASKED_AS: Mapping[InterventionKind, tuple[str, tuple[str, ...]]] = MappingProxyType(
    {
        "swap": ("--kind", ("image-swap", "instruction-swap")),
        "edit": ("--kind", ("interchange", "joint", "steer", "closed-loop", "erase")),
        "attention": ("--kind", ("attention",)),
        "gradients": ("--kind", ("attribution",)),
        "kv": ("--sites", ("kv.*",)),
        "tiles": ("--roles", ("image.left", "image.right")),
    }
)
"""What a family supports, as `probe-kit intervene` asks for it: an option and its values."""
_UNDECLARED = {
    "kv": "its adapter declares no `kv` stream. Patch residual sites instead, or declare `Model.prompt_kv`",
    "attention": "its adapter gives no attention. Patch `kv` or single roles instead: what a patch "
    "moves is read, whatever attention weighs",
    "gradients": "its adapter has no differentiable inference. Patch exactly: `--kind interchange`, or "
    "`--kind joint`, which halves large sets",
    "tiles": "its adapter does not say which picture token comes of which patch. Patch all of `image`, or "
    "declare `Model.patch_order`",
}


@dataclass(frozen=True)
class Interventions:
    """The interventions that a family supports, to test whether a stream is used.

    Following, the comparison of actions on swapped images or words, every policy supports: it is two
    inferences.

    edits: per stored stream the quantities that can be rewritten; None for all that its streams have.
    unread: streams whose end nothing that acts reads: an edit of the last residual or the final norm there leaves
    the actions bit for bit, which makes it a control.
    prompt_kv: whether it keeps keys and values of the prompt that the acting stream reads, see `Model.prompt_kv`.
    first_affected_token: the first output that an edit of backbone or `kv` reaches through `kv`: 0, or 1 where the
    prompt's own pass already chooses the first token.
    attention: whether it records the acting stream's attention to every token of the prompt.
    tiles: whether it says which of the picture's tokens come of which patches, see `Model.patch_order`.
    gradients: whether `Policy.differentiable` gives its actions with a graph.
    readout: `first-chunk` where the first chunk shows where the hand will go; `per-step` where an inference gives
    one action in discrete bins. Conditions are then evaluated at every call of an unedited episode, not executed.
    instead: for what is not supported, why and what to do.
    Raises UsageError for advice on a kind of intervention that does not exist.
    """

    edits: Mapping[str, tuple[str, ...]] | None = None
    unread: tuple[str, ...] = ()
    prompt_kv: bool = False
    first_affected_token: int = 0
    attention: bool = False
    tiles: bool = False
    gradients: bool = False
    readout: Readout = "first-chunk"
    instead: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        if unknown := set(self.instead) - set(get_args(InterventionKind)):
            raise UsageError(f"there is no intervention {', '.join(sorted(unknown))} to advise on")

    def supports(self, kind: InterventionKind) -> bool:
        """Whether `kind` can be asked for."""
        declared = {
            "kv": self.prompt_kv,
            "attention": self.attention,
            "tiles": self.tiles,
            "gradients": self.gradients,
        }
        return declared.get(kind, True)

    def asked_as(self) -> dict[str, list[str]]:
        """The options and values of `probe-kit intervene` that are supported."""
        values_of: dict[str, list[str]] = {}
        for kind, (option, values) in ASKED_AS.items():
            if self.supports(kind):
                values_of.setdefault(option, []).extend(values)
        return values_of

    def check(self, kind: InterventionKind, family: str) -> None:
        """Raises UnsupportedInterventionError if `family`, whose declaration this is, does not support `kind`."""
        if not self.supports(kind):
            why = {**_UNDECLARED, **self.instead}[kind]
            option, values = ASKED_AS[kind]
            request = f"{option} {', '.join(values)}"
            raise UnsupportedInterventionError(
                f"{family} does not support the intervention {kind!r} (`probe-kit intervene {request}`): {why}"
            )

    def to_json(self) -> dict[str, Any]:
        """Plain values, for listings and certificates."""
        return {
            "kinds": [kind for kind in get_args(InterventionKind) if self.supports(kind)],
            "edits": None
            if self.edits is None
            else {name: list(quantities) for name, quantities in self.edits.items()},
            "unread": list(self.unread),
            "first_affected_token": self.first_affected_token,
            "readout": self.readout,
            "instead": dict(self.instead),
        }


ALL_EDITS = Interventions()
"""Default of a family: image swaps, and edits at every site."""
