"""The card of a loaded model: family, checkpoint, weights hash, streams and settings. Imports no torch."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from probe_kit._terminal.notebook import facts_html
from probe_kit.hooks.contract.sites import CAMERA

if TYPE_CHECKING:
    from probe_kit.hooks.contract.sites import Stream


def layers_text(stream: "Stream", unit: str = "iterations") -> str:
    """Return text such as `expert 4 layers x 10 iterations`; `unit` is the name of an iteration in the plural."""
    times = "" if stream.iterations in (None, 1) else f" x {stream.iterations} {unit}"
    return f"{stream.name} {stream.layers} layers{times}"


def streams_text(streams: "Iterable[Stream]") -> str:
    """All streams in one line, such as `expert 4 layers x 10 iterations x 64`; `none` if there are none."""
    return "; ".join(f"{layers_text(stream)} x {stream.width}" for stream in streams) or "none"


def parameters_text(parameters: int) -> str:
    """Return a count in words, such as `0.82 million` or `3.5 billion`."""
    return f"{parameters / 1e9:.1f} billion" if parameters >= 1e9 else f"{parameters / 1e6:.2f} million"


def model_text(name: str, card: "ModelCard", streams: "Mapping[str, Stream]") -> str:
    """A model in one line: family, size, where it runs, streams; random weights in capitals."""
    random = ", RANDOM WEIGHTS" if card.random_weights else ""
    size = f"{parameters_text(card.parameters)} parameters"
    return (
        f"<{name} {card.family}{random}: {size}, {card.dtype} on {card.device}; {streams_text(streams.values())}>"
    )


def model_html(card: "ModelCard", streams: "Mapping[str, Stream]") -> str:
    """The card's facts as a table in HTML."""
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


ARM = "7-DoF end-effector delta, one third-person camera"
"""The embodiment of policies that move the arm of the scene."""
EMBEDDED = "embedded"
"""The checkpoint of a model whose weights come with the package."""


@dataclass(frozen=True)
class SourceWeights:
    """The identity of the weights that a policy's network grew from; None for an unknown part.

    Attributes:
        checkpoint: Hub id of these weights.
        sha256: Their hash, computed as `ModelCard.weights_sha256`.
        parameters: Their count in memory.
    """

    checkpoint: str | None = None
    sha256: str | None = None
    parameters: int | None = None


@dataclass(frozen=True)
class DeclaredInputs:
    """The inputs that a checkpoint declares, by its files or as it is loaded.

    Attributes:
        cameras: The cameras that a picture can be given for, in order.
        state: The count of numbers of the state; None where none is read, or no file says it.
        renames: The model's name of a feature by the name that a data set has, as the checkpoint's files say.
    """

    cameras: tuple[str, ...]
    state: int | None = None
    renames: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ModelCard:
    """The identity of a loaded model: weights, settings and shape.

    Attributes:
        embodiment: The robot whose actions it makes, as people read it; "" where none is known.
        chunk: Actions per inference; 0 for a model that does not act.
        execute: Actions of a chunk that are executed before the next inference; 0 for a model that does not act.
        notes: Sentences for people about what differs from the authors' code or cannot be checked.
        audit: The comparison of the network's tensors with the weights' file, see `WeightsAudit`.
        settings: Everything outside the weights that actions, answers or activations depend on, such as the prompt
            and the contents of every file a loader reads. They are part of a run's identity.
        exact: False if the weights that ran are only near those of the file, as after quantisation.
        weights_seed: Seed of an untrained network; None for weights from a file.
        batch: The largest number of observations per call, None for any; 1 where batching changes the numbers.
        needs: The parts that every observation must hold besides picture, state and instruction; see
            `Observation.lacks`.
        ensemble: Exponent of the weights with which the plans of overlapping chunks for one step are averaged, the
            newest with the largest weight. None executes the head of the newest chunk.
        source: The family of the VLM whose network this policy grew from, if it is one of ours.
        source_weights: The weights of that family; None where they are unknown, as for a checkpoint that is not
            the family's own.
        repositories: Commits of further repositories of the hub that were read, by name: of the base of an
            adapter, a vision-language model or a tokenizer.
        renames: The model's name of a feature by the name that a data set has, as the checkpoint's files rename
            them; see `DeclaredInputs`.
    """

    family: str
    checkpoint: str
    weights_sha256: str
    random_weights: bool
    parameters: int
    dtype: str
    device: str
    embodiment: str = ""
    cameras: tuple[str, ...] = (CAMERA,)
    chunk: int = 0
    execute: int = 0
    notes: tuple[str, ...] = ()
    audit: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)
    exact: bool = True
    weights_seed: int | None = None
    batch: int | None = None
    needs: frozenset[str] = frozenset()
    ensemble: float | None = None
    source: str | None = None
    source_weights: SourceWeights | None = None
    repositories: Mapping[str, str] = field(default_factory=dict)
    renames: Mapping[str, str] = field(default_factory=dict)

    @property
    def shown_cameras(self) -> tuple[str, ...]:
        """The cameras that get a picture; a model may have declared further ones, which stay empty."""
        return shown_cameras(self.cameras, self.needs)

    def inputs(self, state: int | None = None) -> DeclaredInputs:
        """Return cameras and renames beside the count of numbers of the state that the loaded model reads."""
        return DeclaredInputs(self.cameras, state, self.renames)

    def to_json(self) -> dict[str, Any]:
        """Return plain values, as stored in a run's certificate."""
        # Not `asdict`: it copies deeply, which read-only mappings refuse.
        plain = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {
            **plain,
            "cameras": list(self.cameras),
            "notes": list(self.notes),
            "audit": dict(self.audit),
            "settings": dict(self.settings),
            "repositories": dict(self.repositories),
            "renames": dict(self.renames),
            "needs": sorted(self.needs),
            "source_weights": None if self.source_weights is None else asdict(self.source_weights),
        }


def shown_cameras(cameras: Sequence[str], needs: Collection[str]) -> tuple[str, ...]:
    """Return the cameras that get a picture: the first one, and each that an observation must hold."""
    return (*cameras[:1], *(name for name in cameras[1:] if f"camera.{name}" in needs))
