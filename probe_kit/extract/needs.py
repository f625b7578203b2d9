"""Estimated disk space of a run before compression, including probes, figures and report."""

from collections.abc import Mapping, Sequence
from typing import Any

from probe_kit.extract.plan import RowPlan
from probe_kit.extract.run_layout import StoredStream
from probe_kit.extract.settings import RunSettings
from probe_kit.hooks.contract.views import view_names
from probe_kit.hooks.family import DTYPES

EPISODE = 40_000
"""Bytes of an episode's commit, trajectory and files of the file system (measured: 12 to 30 kB)."""
THUMBNAILS = 15_000
"""Bytes of the first and last frame of an episode."""
FRAME = 5_000
"""Bytes of a small frame where all are kept (measured: 4 kB)."""
FILM = 1_500_000
"""Bytes of a film of sixty actions."""
DECISION = 16
"""Bytes that probes keep per site and episode: decisions, labels and directions, by category and pooled."""
REPORT = 5_000_000
"""Bytes of a report with its figures."""


def space_needed(plan: RowPlan, settings: RunSettings) -> dict[str, int]:
    """Bytes by part, uncompressed. Probes are those of one view; more views take as much again each."""
    return space_of(plan.streams, len(plan.episodes), settings)


def space_of(streams: Sequence[StoredStream], episodes: int, settings: RunSettings) -> dict[str, int]:
    """The same for a number of episodes that store these streams."""
    calls, later, with_tokens = settings.stored_calls, settings.stored_later, settings.tokens == "all"
    films = {"all": episodes, "first": 1}.get(str(getattr(settings, "video", "none")), 0)
    pictures = {"none": 0, "ends": THUMBNAILS, "all": FRAME * (settings.scene.max_steps + 1)}[settings.frames]
    sites = sum(len(stream.stream.sites()) for stream in streams)
    return {
        "activations": sum(stream.raw_bytes(with_tokens, calls, later) for stream in streams) * episodes,
        "columns": sum(stream.raw_bytes(False, calls, later) for stream in streams) * episodes,
        "episodes": episodes * (EPISODE + pictures) + films * FILM,
        "probes": sites * episodes * DECISION,
        "report": REPORT if streams else 0,
    }


def weights_needed(model: str, checkpoint: str | None, options: Mapping[str, Any], dtype: str | None) -> str:
    """Memory for the weights and the size of a download, in words; empty for a model that declares no size.

    Of the released size. dtype: None for both. No network is asked, so the stored precision is not known.
    """
    from probe_kit.extract.store.locations.disk import in_units
    from probe_kit.hooks.registry import get_family

    family = get_family(model)
    if family is None or family.weights_bytes(options) is None:
        return ""
    sizes = {name: in_units(family.weights_bytes(options, name) or 0) for name in DTYPES}
    held = {name: in_units(family.memory_bytes(options, name) or 0) for name in DTYPES}
    every = (
        held["float32"] if family.always_float32 else " or ".join(f"{own} in {name}" for name, own in held.items())
    )
    memory = next((own for name, own in held.items() if name == dtype), every)
    download = "nothing to download"
    if not family.is_here(checkpoint, options):
        download = f"download {sizes['bfloat16']} or {sizes['float32']}, as stored"
    return f"memory {memory} for weights, more for activations; {download}"


def declared_streams(settings: RunSettings) -> list[StoredStream] | None:
    """What a run stores of the streams that its family declares; None for one that declares none."""
    from probe_kit.hooks.registry import get_family

    family = get_family(settings.model)
    declared = None if family is None else family.declared_streams(settings.options)
    if declared is None:
        return None
    if settings.tokens == "none":
        return []
    return [StoredStream.of(one.stream, one.tokens, view_names(one.roles)) for one in declared]
