"""Declarations of a family: scene, options, protocols, streams, interventions. Imports no torch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib import import_module
from types import MappingProxyType
from typing import Any, Literal, get_args

from probe_kit.errors import UnsupportedInterventionError, UsageError
from probe_kit.hooks.contract.card import layers_text
from probe_kit.hooks.contract.sites import Stream


@dataclass(frozen=True)
class DefaultScene:
    """The scene of a family by default.

    Attributes:
        preset: Name of the preset of the scene, as in `SceneSpec.preset`.
        changes: Fields that differ from the preset, by name; they hold also when other fields are asked for.
    """

    preset: str
    changes: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    def __str__(self) -> str:
        """The preset and its changes, as `probe-kit models` shows them."""
        return ", ".join([self.preset, *(f"{name} {value}" for name, value in self.changes.items())])


RELEASED = DefaultScene("act2answer")
"""The scene of every family that declares no other: policies and VLMs of one study get the same first frames."""
EMBEDDED = DefaultScene("act2answer", MappingProxyType({"early_stop": True, "max_steps": 40}))
"""The scene of the embedded models, whose demonstrations took at most 40 actions."""


# -- options --------------------------------------------------------------------------------------------------

# For text options of kind bool; Python's own `bool("false")` is True.
_WORDS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}
_EXPECTED = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}

LARGEST = 1 << 31
"""The largest number that an option can be; larger ones, and NaN, are mistakes."""

Kind = type[bool] | type[int] | type[float] | type[str]


@dataclass(frozen=True)
class Option:
    """One option of a family.

    Attributes:
        kind: The type of its value: bool, int, float or str.
        help: One line for `probe-kit models NAME`.
        default: The default as people read it.
        choices: The admissible values; empty for any of the kind.
        is_path: Whether it may name a file or folder, which a run finds again wherever its command was typed.
    """

    name: str
    kind: Kind
    help: str
    default: str = ""
    choices: tuple[Any, ...] = ()
    is_path: bool = False

    def value(self, raw: Any) -> Any:
        """Return `raw`, text or already of the kind, as the loader gets it.

        Raises:
            UsageError: If it is not of the kind or not among the choices.
        """
        value = self._read(raw)
        if self.choices and value not in self.choices:
            allowed = ", ".join(map(str, self.choices))
            raise UsageError(f"model option {self.name} is {raw!r}; expected one of {allowed}")
        return value

    def _read(self, raw: Any) -> Any:
        if self.kind is float and type(raw) is int:
            return float(raw)
        if type(raw) is self.kind:
            return raw
        try:
            if not isinstance(raw, str):
                raise ValueError
            value = _WORDS[raw.lower()] if self.kind is bool else self.kind(raw)
            if isinstance(value, int | float) and not abs(value) <= LARGEST:  # `not <=` also catches NaN
                raise ValueError
            return value
        except (ValueError, KeyError, OverflowError):
            raise UsageError(f"model option {self.name} is {raw!r}; expected {_EXPECTED[self.kind]}") from None


def read_pairs(pairs: Sequence[str]) -> dict[str, str]:
    """Return `key=value` texts as a dict, with underscores for the hyphens of a key.

    Raises:
        UsageError: For a text of another form and for a key given twice.
    """
    options: dict[str, str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or not key.strip():
            raise UsageError(f"model option {pair!r} is not KEY=VALUE, such as -M unnorm_key=bridge_orig")
        name = key.strip().replace("-", "_")
        if name in options:
            raise UsageError(f"model option {name} is given twice: {options[name]!r} and {value!r}")
        options[name] = value
    return options


def check_options(family: str, declared: Sequence[Option], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the given options as the loader gets them.

    Raises:
        UsageError: For an option that the family does not declare, and for a value that the option does not admit.
    """
    by_name = {option.name: option for option in declared}
    for name in sorted(options):
        if name not in by_name:
            near = get_close_matches(name, by_name, n=1)
            hint = f" Did you mean {near[0]}?" if near else ""
            available = f"it has {', '.join(sorted(by_name))}" if by_name else "it has none"
            raise UsageError(f"{family} has no model option {name}; {available}.{hint}")
    return {name: by_name[name].value(value) for name, value in options.items()}


# -- protocols ------------------------------------------------------------------------------------------------

Rotation = Literal["roll-pitch-yaw", "axis-angle"]
"""The form in which the rotation of an action reaches the controller; see `ProtocolRow.rotation`."""
ROTATIONS: tuple[Rotation, ...] = get_args(Rotation)
PLAIN: Rotation = "roll-pitch-yaw"


@dataclass(frozen=True)
class ProtocolRow:
    """The settings with which a protocol uses a family.

    Attributes:
        execute: Actions executed per inference.
        options: Options of the family, whatever the checkpoint.
        of_checkpoint: The options that only the protocol's own checkpoint needs.
        rotation: `roll-pitch-yaw` passes the angles of an action on. `axis-angle` passes axis times angle of the
            same turn on, which the controller then reads as angles.
        unmatched: The parts of the protocol that cannot be done here.
        variant: The name of this checkpoint among several, as in labels.
        alternatives: Rows of the others; without a checkpoint, the row that holds them is used.
    """

    checkpoint: str
    execute: int
    dtype: str
    options: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    of_checkpoint: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    rotation: Rotation = PLAIN
    unmatched: tuple[str, ...] = ()
    variant: str = ""
    alternatives: "tuple[ProtocolRow, ...]" = ()

    @property
    def rows(self) -> "tuple[ProtocolRow, ...]":
        """The row itself and its alternatives."""
        return (self, *self.alternatives)

    def of(self, checkpoint: str | None) -> "ProtocolRow":
        """Return the row of `checkpoint`, at any revision.

        It is this row for None, and for a checkpoint that the protocol does not use.
        """
        return next((row for row in self.rows if row.checkpoint == _bare(checkpoint)), self)

    def options_for(self, checkpoint: str | None) -> dict[str, Any]:
        """Return the options with `checkpoint`; None takes the protocol's own."""
        checkpoint_options = self.of_checkpoint if _bare(checkpoint) in (None, self.checkpoint) else {}
        return {**checkpoint_options, **self.options}

    def settings(self) -> dict[str, str]:
        """Every setting by name, as text; those of the family with -M in front."""
        return {
            "checkpoint": self.checkpoint,
            "execute": str(self.execute),
            "rotation": self.rotation,
            "dtype": self.dtype,
            **{f"-M {name}": as_text(value) for name, value in self.options_for(None).items()},
        }


def _bare(checkpoint: str | None) -> str | None:
    """A hub id without the revision at which it is read."""
    return None if checkpoint is None else checkpoint.partition("@")[0]


def as_text(value: Any) -> str:
    """An option's value as it is given on the command line."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


ProtocolName = Literal["act2answer"]
ACT2ANSWER: ProtocolName = "act2answer"
OWN_SEEDS = "draws come from the episode's seed; the release seeds once per process"
"""A difference from the release that every sampling family has, see `ProtocolRow.unmatched`."""


# -- streams --------------------------------------------------------------------------------------------------

TEXT = ("language", "special")
"""The roles that every stream with a prompt has."""


@dataclass(frozen=True)
class DeclaredStream:
    """A stream of a family at a released size.

    Attributes:
        tokens: The approximate count at a picture of 640 × 480 and an instruction of ten words; sizes of runs are
            estimated by it.
        roles: The roles that its tokens can play.
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
    """A language model that reads one picture and text; `more` are roles besides those of picture and text."""
    return DeclaredStream(Stream("backbone", layers, width, sums=sums), tokens, (f"image.{camera}", *TEXT, *more))


def chosen_tokens(name: str, layers: int, width: int, iterations: int, sums: bool = True) -> DeclaredStream:
    """The positions of a language model that choose its output, one per iteration."""
    return DeclaredStream(Stream(name, layers, width, iterations, part="action", sums=sums), 1, (name,))


def expert(
    layers: int, width: int, iterations: int, tokens: int, roles: tuple[str, ...], **fields: Any
) -> DeclaredStream:
    """A flow or diffusion transformer, with its tokens at every iteration; `fields` are others of `Stream`."""
    shape = {"name": "expert", "part": "action", **fields}
    return DeclaredStream(Stream(layers=layers, width=width, iterations=iterations, **shape), tokens, roles)


def answering(layers: int, width: int, tokens: int, sums: bool = True) -> tuple[DeclaredStream, ...]:
    """The two streams of a VLM that answers."""
    return backbone(layers, width, tokens, sums=sums), chosen_tokens("answer", layers, width, 1, sums)


# -- interventions --------------------------------------------------------------------------------------------

InterventionKind = Literal["swap", "edit", "kv", "attention", "knockout", "tiles", "gradients"]
Readout = Literal["first-chunk", "per-step"]
"""The readout with which interventions of a family are compared.

`first-chunk` is the lateral displacement by the first inference's actions, none of them executed. `per-step` is
its sum over every inference of the unedited episode; only the clean actions are executed.
"""
_VALUES: Mapping[str, tuple[str, tuple[str, ...]]] = MappingProxyType(
    {"kv": ("--sites", ("kv.*",)), "tiles": ("--roles", ("image.left", "image.right"))}
)
_KINDS = "probe_kit.intervene.kinds"
"""A package above this one, whose kinds say themselves what a family must support for them."""


def asked_as(kind: InterventionKind) -> tuple[str, tuple[str, ...]]:
    """Return the option of `probe-kit intervene` that asks for such an intervention, and its values."""
    if kind in _VALUES:
        return _VALUES[kind]
    names: tuple[str, ...] = import_module(_KINDS).kinds_that_need(kind)
    return "--kind", names


_UNDECLARED = {
    "kv": "its adapter declares no `kv` stream. Patch residual sites instead, or declare `Model.prompt_kv`",
    "attention": "its adapter gives no attention. Patch `kv` or single roles instead: what a patch "
    "moves is read, whatever attention weighs",
    "knockout": "its adapter gives no attention to cut. Patch `kv` or single roles instead",
    "gradients": "its adapter has no differentiable inference. Patch exactly: `--kind interchange`, or "
    "`--kind joint`, which halves large sets",
    "tiles": "its adapter does not say which picture token comes of which patch. Patch all of `image`, or "
    "declare `Model.patch_order`",
}


@dataclass(frozen=True)
class Interventions:
    """The interventions that a family supports, to test whether a stream is used.

    Swaps of images or words are not declared: every policy supports them, as two inferences.

    Attributes:
        edits: Per stored stream the quantities that can be rewritten; None for all that its streams have.
        unread: Streams whose end nothing that acts reads. An edit of the last residual or the final norm there
            leaves the actions bit for bit, which makes it a control.
        prompt_kv: Whether it keeps keys and values of the prompt that the acting stream reads, see
            `Model.prompt_kv`.
        first_affected_token: The first output that an edit of backbone or `kv` reaches through `kv`. It is 0, or 1
            where the prompt's own pass already chooses the first token.
        attention: Whether it records the acting stream's attention to every token of the prompt.
        tiles: Whether it says which of the picture's tokens come of which patches, see `Model.patch_order`.
        gradients: Whether `Policy.differentiable` gives its actions with a graph.
        readout: `first-chunk` where the first chunk shows where the hand will go; `per-step` where an inference
            gives one action in discrete bins. Conditions are then evaluated at every call of an unedited episode,
            not executed.
        instead: The reason and the advice for each kind of intervention that is not supported.

    Raises:
        UsageError: For advice on a kind of intervention that does not exist.
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
            "knockout": self.attention and "knockout" not in self.instead,
            "tiles": self.tiles,
            "gradients": self.gradients,
        }
        return declared.get(kind, True)

    def asked_as(self) -> dict[str, list[str]]:
        """The options and values of `probe-kit intervene` that are supported."""
        values_of: dict[str, list[str]] = {}
        for kind in get_args(InterventionKind):
            option, values = asked_as(kind)
            if self.supports(kind):
                values_of.setdefault(option, []).extend(values)
        return values_of

    def check(self, kind: InterventionKind, family: str) -> None:
        """Check that `family`, whose declaration this is, supports `kind`.

        Raises:
            UnsupportedInterventionError: If it does not.
        """
        if not self.supports(kind):
            why = {**_UNDECLARED, **self.instead}[kind]
            option, values = asked_as(kind)
            request = f"{option} {', '.join(values)}"
            raise UnsupportedInterventionError(
                f"{family} does not support the intervention {kind!r} (`probe-kit intervene {request}`): {why}"
            )

    def to_json(self) -> dict[str, Any]:
        """Return plain values, for listings and certificates."""
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
"""The default of a family: image swaps, and edits at every site."""
