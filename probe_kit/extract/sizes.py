"""The disk space and memory that a run needs, before it is begun. Writes nothing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit.errors import ProbeKitError
from probe_kit.extract.settings import Settings
from probe_kit.extract.states import Fitted
from probe_kit.hooks.contract.sites import view_names
from probe_kit.hooks.family import DTYPES
from probe_kit.runs.layout import StoredStream
from probe_kit.runs.plan import Plan

if TYPE_CHECKING:
    from probe_kit.hooks import Family, Model
    from probe_kit.hooks.outline import Outline


EPISODE = 40_000
"""The bytes of an episode's commit, trajectory and files of the file system (measured: 12 to 30 kB)."""
THUMBNAILS = 15_000
"""The bytes of the first and last frame of an episode."""
FRAME = 5_000
"""The bytes of a small frame where all are kept (measured: 4 kB)."""
FILM = 1_500_000
"""The bytes of a film of sixty actions."""
DECISION = 16
"""The bytes that probes keep per site and episode: decisions, labels and directions, by category and pooled."""
_PICTURE, _INSTRUCTION = (480, 640), "put the red block on the green plate to the left"
"""An observation of usual size, whose tokens are counted where no other is known."""
REPORT = 5_000_000
"""The bytes of a report with its figures."""


def space_needed(plan: Plan, fitted: Fitted[Settings]) -> dict[str, int]:
    """Return the bytes by part, uncompressed. Probes are those of one view; each further view takes as much."""
    return space_of(plan.streams, len(plan.episodes), fitted)


def space_of(streams: Sequence[StoredStream], episodes: int, fitted: Fitted[Settings]) -> dict[str, int]:
    """Return the bytes by part, uncompressed, of a number of episodes that store these streams."""
    settings, calls = fitted.settings, fitted.calls
    later, with_tokens = settings.capture.later_views, settings.capture.tokens == "all"
    machine, frames = settings.machine, settings.source.steps() + 1
    films = {"all": episodes, "first": 1, "none": 0}[machine.video]
    pictures = {"none": 0, "ends": THUMBNAILS, "all": FRAME * frames}[machine.frames]
    sites = sum(len(stream.stream.sites()) for stream in streams)
    return {
        "activations": sum(stream.raw_bytes(with_tokens, calls, later) for stream in streams) * episodes,
        "columns": sum(stream.raw_bytes(False, calls, later) for stream in streams) * episodes,
        "episodes": episodes * (EPISODE + pictures) + films * FILM,
        "probes": sites * episodes * DECISION,
        "report": REPORT if streams else 0,
    }


@dataclass(frozen=True)
class PlannedSizes:
    """The sizes of a model that was not loaded.

    Attributes:
        streams: The streams as a run stores them.
        source: The origin of the sizes, in words.
        outline: The model without weights, where its configuration is on this machine.
    """

    streams: tuple[StoredStream, ...]
    source: str
    outline: "Outline | None" = None

    @property
    def execute(self) -> int:
        """The number of executed actions of an inference; 1 if it is unknown, as a model may execute more."""
        model = None if self.outline is None else self.outline.model
        return 1 if model is None else max(1, model.card.execute)


def planned_sizes(settings: Settings, instructions: Sequence[str] = ()) -> PlannedSizes | None:
    """Return the streams of a model by its configuration, where that is here, else as its family declares them.

    Reads no weights and asks no network. A checkpoint in a folder raises what loading it raises.

    Args:
        settings: The settings of the run.
        instructions: The texts that it will read, for the number of tokens; empty for one of about ten words.

    Returns:
        None for a model that declares no streams.
    """
    from probe_kit.hooks.registry import get_family

    family = get_family(settings.model.family)
    declared = None if family is None else family.declared_streams(settings.model.options)
    if family is None or declared is None:
        return None
    outline = family.outline(settings.model.checkpoint, settings.model.options, settings.model.dtype)
    if outline is None or outline.model is None:
        streams = [
            StoredStream.of(declared_stream.stream, declared_stream.tokens, view_names(declared_stream.roles))
            for declared_stream in declared
        ]
        why = "" if outline is None else f", because its own configuration cannot be read here: {outline.reason}"
        source = f"of the released size{why}"
    else:
        tokens = _tokens(outline.model, instructions or (_INSTRUCTION,))
        average = {declared_stream.stream.name: declared_stream.tokens for declared_stream in declared}
        names = outline.model.role_names
        streams = [
            StoredStream.of(stream, tokens.get(name, average.get(name, 1)), view_names(names[name]))
            for name, stream in outline.model.streams.items()
        ]
        counted = (
            "" if tokens else "; its tokenizer is not here, so that numbers of tokens are of the released size"
        )
        source = f"of the checkpoint's configuration{counted}"
    return PlannedSizes(tuple(streams) if settings.capture.tokens != "none" else (), source, outline)


def _tokens(model: "Model", instructions: Sequence[str]) -> dict[str, int]:
    """Return the longest sequence of every stream; empty where its tokenizer or processor is not here."""
    from probe_kit.hooks.checkpoints.checkpoint import without_network
    from probe_kit.hooks.contract.observation import Observation

    picture, state = np.zeros((*_PICTURE, 3), np.uint8), np.zeros(8, np.float32)
    example = Observation(picture, state, max(instructions, key=len), np.eye(3, dtype=np.float32))
    try:
        with without_network():
            roles = model.roles([example])
    except Exception:  # noqa: BLE001 - whatever is missing, the number of the released size stands for it
        return {}
    return {name: max(len(row) for row in rows) for name, rows in roles.items()}


def _parameters(
    family: "Family", checkpoint: str | None, options: Mapping[str, Any], dtype: str | None
) -> int | None:
    """Count the parameters of a network by the configuration that is here; None without a usable one."""
    try:
        outline = family.outline(checkpoint, options, dtype)
    except ProbeKitError:  # a plan or a run of this checkpoint says what is wrong with it
        return None
    return None if outline is None or outline.model is None else outline.model.card.parameters


def weights_bytes_needed(model: str) -> dict[str, Any]:
    """Return the bytes of a released model's weights in memory by dtype, and of its download.

    Empty for a model that declares no size; see `weights_needed`. A download that no index counts is missing.
    """
    from probe_kit.hooks.registry import get_family

    family = get_family(model)
    if family is None or family.weights_bytes({}) is None:
        return {}
    names = DTYPES[:1] if family.requirements.always_float32 else DTYPES
    count = _parameters(family, None, {}, None)
    fetched = 0 if family.is_here(None, {}) else family.bytes_to_fetch(None, {})
    download = {} if fetched is None else {"download_bytes": fetched}
    return {"memory_bytes": {name: family.memory_bytes({}, name, count) for name in names}, **download}


def weights_needed(
    model: str,
    checkpoint: str | None,
    options: Mapping[str, Any],
    dtype: str | None,
    parameters: int | None = None,
) -> str:
    """Return memory for the weights and the size of a download, in words; empty for a model that declares no size.

    The sizes are those of the checkpoint's configuration where it is here, else the released ones. No network is
    asked: a download is counted from the index of the weights in the cache. Else it is estimated from the number
    of parameters, whose stored precision is not known.

    Args:
        model: The name of a family.
        checkpoint: A folder or hub id; None for the family's default.
        options: The options of the family, by name.
        dtype: The data type of the weights; None for float32 and bfloat16.
        parameters: The number of parameters of a model that is loaded; None for one that is not.
    """
    from probe_kit.hooks.registry import get_family
    from probe_kit.runs.run_folders import in_units

    family = get_family(model)
    if family is None or family.weights_bytes(options) is None:
        return ""
    count = _parameters(family, checkpoint, options, dtype) if parameters is None else parameters
    sizes = {name: in_units(family.weights_bytes(options, name, count) or 0) for name in DTYPES}
    memory_by_dtype = {name: in_units(family.memory_bytes(options, name, count) or 0) for name in DTYPES}
    every = (
        memory_by_dtype["float32"]
        if family.requirements.always_float32
        else " or ".join(f"{size} in {name}" for name, size in memory_by_dtype.items())
    )
    memory = next((size for name, size in memory_by_dtype.items() if name == dtype), every)
    download = "nothing to download"
    if not family.is_here(checkpoint, options):
        counted = family.bytes_to_fetch(checkpoint, options)
        download = (
            f"download {in_units(counted)}"
            if counted
            else (
                f"download about {sizes['bfloat16']} or {sizes['float32']}, as stored, estimated from the "
                "parameters"
            )
        )
    return f"memory {memory} for weights, more for activations; {download}"
