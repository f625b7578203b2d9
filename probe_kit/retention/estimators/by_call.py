"""Accuracies of probes at each captured inference of an episode, counted from its beginning or from an event."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.scoring.events import EVENTS, Events
from probe_kit.errors import TooFewGroupsError, UsageError
from probe_kit.retention.estimators.retention import best_site
from probe_kit.retention.estimators.stream_scores import score_streams
from probe_kit.statistics.estimates.verdict import FEWEST_PERMUTATIONS
from probe_kit.train.results.control_scores import has_signal
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

Shares = NDArray[np.float64]
EventCalls = Mapping[str, Mapping[str, int]]
"""Per event, by episode id, the captured inference before it."""


@dataclass(frozen=True)
class CallLine:
    """Held-out accuracy of a stream's best site by captured inference; arrays (C,), accuracies as shares.

    accuracy: of the sites that the inner folds choose, on the outer folds; low, high: its 95 % interval, NaN with
    too few groups. significant: above chance against all sites of the
    stream, and above the controls that were run. null: what the best site of permuted labels stays below in 95 %,
    NaN with few label permutations. episodes: how many got that far. part: of the model, see `Stream.part`.
    """

    stream: str
    part: str
    calls: NDArray[np.int64]
    accuracy: Shares
    low: Shares
    high: Shares
    significant: NDArray[np.bool_]
    null: Shares
    episodes: NDArray[np.int64]


@dataclass(frozen=True)
class AlignedLine:
    """The same counted from an event of each episode: 0 is the last inference before the action that brought it
    about. Sites are those that the inner folds of every call choose. There is no interval; (O,) offsets with at
    least `FEWEST` episodes.
    """

    stream: str
    part: str
    offsets: NDArray[np.int64]
    accuracy: Shares
    episodes: NDArray[np.int64]


@dataclass(frozen=True)
class EventTimes:
    """At which captured inference an event fell due: median and quartiles over the episodes that have it."""

    event: str
    median: float
    low: float
    high: float
    share: float


FEWEST = 10
"""Episodes from which on an accuracy is shown."""


@dataclass(frozen=True)
class CallCurves:
    """One category in one view over the captured inferences of a run.

    results: the probes by call. events: when they fell due, as `event_calls` says; empty without trajectories.
    """

    results: Mapping[int, ProbeResults]
    category: str
    view: str
    events: EventCalls

    @classmethod
    def of(
        cls, results: Mapping[int, ProbeResults], category: str, view: str, events: EventCalls | None = None
    ) -> Self:
        """Read probes by call, as `load_results_by_call` gives them. events: as `event_calls` gives them.

        Raises UsageError for probes of a single call, or without that category and view.
        """
        if len(results) < 2:
            raise UsageError(
                f"probes of call {', '.join(map(str, results))} make no curve over calls; extract with "
                "--captured-calls N and fit them with `probe-kit train --call all`"
            )
        if lacking := [call for call, probes in results.items() if (category, view) not in probes.curves]:
            raise UsageError(f"call {lacking[0]} has no probes of category {category!r} in view {view!r}")
        return cls(results, category, view, events or {})

    @property
    def streams(self) -> tuple[str, ...]:
        """Return the streams that were probed at every call, in order."""
        curves = list(self._curves.values())
        first = dict.fromkeys(site.stream for site in curves[0].sites)
        return tuple(name for name in first if all(curve.stream(name).size for curve in curves))

    def line(self, stream: str) -> CallLine:
        """The stream's best site at each call."""
        points = [self._point(call, curve, stream) for call, curve in self._curves.items()]
        accuracy, low, high, significant, null, episodes = map(np.array, zip(*points, strict=True))
        calls = np.array(list(self._curves), np.int64)
        return CallLine(stream, self._part(stream), calls, accuracy, low, high, significant, null, episodes)

    def aligned(self, stream: str, event: str) -> AlignedLine | None:
        """The stream's best sites counted from an event; None where too few episodes have it."""
        pools: dict[int, list[bool]] = {}
        for call, curve in self._curves.items():
            right = curve.nested_correct(curve.stream(stream))
            for episode, hit in zip(curve.episodes, right, strict=True):
                due = self.events.get(event, {}).get(str(episode))
                if due is not None:
                    pools.setdefault(call - due, []).append(bool(hit))
        large = {offset: pools[offset] for offset in sorted(pools) if len(pools[offset]) >= FEWEST}
        if not large:
            return None
        accuracy = np.array([np.mean(pool) for pool in large.values()])
        sizes = np.array([len(pool) for pool in large.values()], np.int64)
        offsets = np.array(list(large), np.int64)
        return AlignedLine(stream, self._part(stream), offsets, accuracy, sizes)

    def event_times(self) -> list[EventTimes]:
        """Return when the events of this category's episodes fell due; those that no episode has are left out."""
        episodes = self._curves[min(self._curves)].episodes
        times = []
        for event, calls in self.events.items():
            due = [calls[str(episode)] for episode in episodes if str(episode) in calls]
            if due:
                low, median, high = np.percentile(due, [25, 50, 75])
                times.append(EventTimes(event, float(median), float(low), float(high), len(due) / len(episodes)))
        return times

    @property
    def _curves(self) -> dict[int, ProbeCurve]:
        return {call: probes.curves[self.category, self.view] for call, probes in self.results.items()}

    def _part(self, stream: str) -> str:
        curve = next(iter(self._curves.values()))
        return curve.parts[int(curve.stream(stream)[0])]

    def _accuracy(self, curve: ProbeCurve, stream: str) -> tuple[float, float, float]:
        seed_text = next(iter(self.results.values())).settings.seed_text
        try:
            scores = score_streams(curve, {stream: curve.stream(stream)}, seed_text)
        except TooFewGroupsError:
            return float(curve.sums.only(curve.stream(stream)).accuracies.max()), np.nan, np.nan
        assert scores is not None, "one stream was given"
        interval = scores.interval(stream)
        return scores.accuracy(stream), interval.low, interval.high

    def _point(self, call: int, curve: ProbeCurve, stream: str) -> tuple[float, float, float, bool, float, int]:
        peak = best_site(curve, stream)
        assert peak is not None, "the stream was probed at every call"
        exceeds = self.results[call].controls.exceeds(self.category, self.view, str(peak.site), peak.p_fwe)
        best_null = curve.null[curve.stream(stream)]
        null = np.percentile(best_null.max(axis=0), 95) if best_null.shape[1] >= FEWEST_PERMUTATIONS else np.nan
        return (
            *self._accuracy(curve, stream),
            has_signal(exceeds),
            float(null),
            curve.labels.size,
        )


def event_calls(run: Any) -> EventCalls:
    """Per event, by episode id, the last inference before the action that brought it about.

    Nothing for a run without trajectories. Inference c decides actions c · k + 1 to (c + 1) · k, with k actions
    executed per inference.
    """
    if not run.has_trajectories:
        return {}
    executed = int(run.settings["execute"])
    by_event: dict[str, dict[str, int]] = {event: {} for event in EVENTS}
    for episode, trajectory in zip(run.episodes["episode_id"], run.trajectories, strict=True):
        events = Events.of(trajectory)
        for event in EVENTS:
            frame = events.frame(event)
            if frame is not None and frame > 0:
                by_event[event][str(episode)] = (frame - 1) // executed
    return by_event
