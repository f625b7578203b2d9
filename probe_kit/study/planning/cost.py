"""What the missing episodes of a study take: hours, each with its source, and bytes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from probe_kit.extract.needs import PlannedSizes, planned_sizes, space_of
from probe_kit.extract.settings import ExtractSettings, Settings
from probe_kit.hooks.registry import family_names
from probe_kit.runs.layout import StoredStream
from probe_kit.study.cells import Cell
from probe_kit.study.ledger import Ledger, Speed

Source = Literal["stored episodes", "calibrated"]


@dataclass(frozen=True)
class Work:
    """Missing episodes of a cell. seconds: per episode, measured in stored ones. streams: of what is stored."""

    cell: Cell
    done: int
    missing: int
    seconds: float | None = None
    streams: Sequence[StoredStream] | None = None


@dataclass(frozen=True)
class Cost:
    """Of missing episodes. seconds: by run, as far as a rate is known. sources: of the rates, by model.

    bytes: by model, uncompressed, with columns and probes. unmeasured, unsized: models without a rate, or of which
    no stream is known before they are loaded.
    """

    seconds: Mapping[str, float]
    hours: Mapping[str, float]
    sources: Mapping[str, Source]
    bytes: Mapping[str, int]
    unmeasured: tuple[str, ...]
    unsized: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "hours": dict(self.hours),
            "hours_from": dict(self.sources),
            "unmeasured": list(self.unmeasured),
            "bytes": dict(self.bytes),
            "unsized": list(self.unsized),
        }


def cost_of(works: Iterable[Work], ledger: Ledger) -> Cost:
    """What cells lack. A rate measured in stored episodes of the model goes before a calibrated one."""
    works = list(works)
    rates, calibrated = _rates(works), ledger.speeds()
    stored = {speed_name(one.cell): one.streams for one in works if one.streams is not None}
    seconds: dict[str, float] = {}
    hours: dict[str, float] = {}
    sources: dict[str, Source] = {}
    sizes: dict[str, int] = {}
    unmeasured, unsized = list[str](), list[str]()
    for one in (own for own in works if own.missing):
        model, own = one.cell.model, rates.get(speed_name(one.cell))
        source: Source = "stored episodes" if own is not None else "calibrated"
        own = _calibrated(one.cell, calibrated) if own is None else own
        if own is None:
            unmeasured.append(model)
        else:
            seconds[one.cell.name] = own * one.missing * units(one.cell)
            hours[model] = hours.get(model, 0.0) + seconds[one.cell.name] / 3600
            sources[model] = source
        size = _bytes(one, stored.get(speed_name(one.cell)), calibrated)
        if size is None:
            unsized.append(model)
        else:
            sizes[model] = sizes.get(model, 0) + size * one.missing
    return Cost(seconds, hours, sources, sizes, _once(unmeasured), _once(unsized))


def speed_name(cell: Cell) -> str:
    """What shares one rate: a model that acts, is captured without acting, or is asked."""
    captured = cell.captured
    return f"{cell.model}, {'asked' if cell.asks else 'captured' if captured else 'acting'}"


def units(cell: Cell) -> float:
    """Inferences of an episode at most, in which conditions differ; 1 for what has no policy that acts."""
    return cell.inferences / cell.episodes if cell.inferences else 1.0


def _rates(works: Sequence[Work]) -> dict[str, float]:
    """Seconds per unit of each kind of work, as a mean over stored episodes."""
    spent: dict[str, float] = {}
    counted: dict[str, float] = {}
    for one in works:
        if one.seconds is not None and one.done:
            name = speed_name(one.cell)
            spent[name] = spent.get(name, 0.0) + one.seconds * one.done
            counted[name] = counted.get(name, 0.0) + units(one.cell) * one.done
    return {name: spent[name] / counted[name] for name in spent}


def _calibrated(cell: Cell, speeds: Mapping[str, Speed]) -> float | None:
    """Seconds per unit, unless they were measured with another batch or on another device."""
    found, settings = speeds.get(speed_name(cell)), cell.settings
    if found is None or (found.batch, found.device) != (settings.machine.observations, settings.machine.device):
        return None
    return found.seconds


def _bytes(one: Work, stored: Sequence[StoredStream] | None, speeds: Mapping[str, Speed]) -> int | None:
    """Of an episode: from stored streams, else as the family declares them, else from a calibration."""
    settings, streams = one.cell.settings, one.streams or stored
    if streams is None:  # a script has no network
        sizes = planned_sizes(settings) if settings.model.family in family_names() else PlannedSizes((), "")
        streams = None if sizes is None else sizes.streams
    if streams is not None:
        return bytes_per_episode(streams, settings)
    found = speeds.get(speed_name(one.cell))
    return None if found is None or found.tokens != settings.capture.tokens else found.bytes


def bytes_per_episode(streams: Sequence[StoredStream], settings: Settings) -> int:
    """Uncompressed bytes of an episode with columns and probes, without a report.

    Those of an episode with the most inferences, where every one is captured.
    """
    if isinstance(settings, ExtractSettings):
        settings = settings.with_every_call(settings.task.execute or 1)
    space = space_of(streams, 1, settings)
    return sum(space.values()) - space["report"]


def _once(names: list[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))
