"""The cost of missing episodes of a study: hours, by stored episodes of the same model, and bytes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from probe_kit.extract.needs import planned_sizes, space_of
from probe_kit.extract.settings import ExtractSettings, Settings
from probe_kit.hooks.registry import family_names
from probe_kit.runs.layout import StoredStream
from probe_kit.study.cells import Cell


@dataclass(frozen=True)
class Work:
    """Missing episodes of a cell. seconds: per episode, measured in stored ones. streams: of what is stored."""

    cell: Cell
    stored: int
    missing: int
    seconds: float | None = None
    streams: Sequence[StoredStream] | None = None


@dataclass(frozen=True)
class Cost:
    """The cost of missing episodes. seconds: by run, as far as a rate is known. hours: by model.

    bytes: by model, uncompressed, with columns and probes. unmeasured, unsized: models without a stored episode,
    or of which no stream is known before they are loaded.
    """

    seconds: Mapping[str, float]
    hours: Mapping[str, float]
    bytes: Mapping[str, int]
    unmeasured: tuple[str, ...]
    unsized: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "hours": dict(self.hours),
            "unmeasured": list(self.unmeasured),
            "bytes": dict(self.bytes),
            "unsized": list(self.unsized),
        }


def cost_of(works: Iterable[Work]) -> Cost:
    """Return the cost of what cells lack."""
    works = list(works)
    rates = _rates(works)
    stored = {_rate_name(work.cell): work.streams for work in works if work.streams is not None}
    seconds: dict[str, float] = {}
    hours: dict[str, float] = {}
    sizes: dict[str, int] = {}
    unmeasured, unsized = list[str](), list[str]()
    for work in (each for each in works if each.missing):
        model, name = work.cell.model, _rate_name(work.cell)
        if name not in rates:
            unmeasured.append(model)
        else:
            seconds[work.cell.name] = rates[name] * work.missing * units(work.cell)
            hours[model] = hours.get(model, 0.0) + seconds[work.cell.name] / 3600
        size = _bytes(work, stored.get(name))
        if size is None:
            unsized.append(model)
        else:
            sizes[model] = sizes.get(model, 0) + size * work.missing
    return Cost(seconds, hours, sizes, tuple(dict.fromkeys(unmeasured)), tuple(dict.fromkeys(unsized)))


def _rate_name(cell: Cell) -> str:
    """Return the name of what shares one rate: a model that acts, is captured without acting, or is asked."""
    return f"{cell.model}, {'asked' if cell.asks else 'captured' if cell.captured else 'acting'}"


def units(cell: Cell) -> float:
    """Return the most inferences of an episode, in which conditions differ; 1 for what has no policy that acts."""
    return cell.inferences / cell.episodes if cell.inferences else 1.0


def _rates(works: Sequence[Work]) -> dict[str, float]:
    """Return the seconds per unit of each kind of work, as a mean over stored episodes."""
    spent: dict[str, float] = {}
    counted: dict[str, float] = {}
    for work in works:
        if work.seconds is not None and work.stored:
            name = _rate_name(work.cell)
            spent[name] = spent.get(name, 0.0) + work.seconds * work.stored
            counted[name] = counted.get(name, 0.0) + units(work.cell) * work.stored
    return {name: spent[name] / counted[name] for name in spent}


def _bytes(work: Work, stored: Sequence[StoredStream] | None) -> int | None:
    """Return the bytes of an episode: by stored streams, else as the configuration or the family declares them."""
    settings, streams = work.cell.settings, work.streams or stored
    if streams is None and settings.model.family in family_names():
        sizes = planned_sizes(settings)
        if sizes is None:
            return None
        streams = sizes.streams
    return bytes_per_episode(streams or (), settings)  # a script has no network, and no stream


def bytes_per_episode(streams: Sequence[StoredStream], settings: Settings) -> int:
    """Return the uncompressed bytes of an episode with columns and probes, without a report.

    Of an episode with the most inferences, where every one is captured.
    """
    if isinstance(settings, ExtractSettings):
        settings = settings.with_every_call(settings.task.execute or 1)
    space = space_of(streams, 1, settings)
    return sum(space.values()) - space["report"]
