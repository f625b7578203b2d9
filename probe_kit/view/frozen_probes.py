"""Probes of one inference applied to every captured inference of an episode, held out by fold."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.sites import Site, resolve_view
from probe_kit.runs import Run
from probe_kit.runs.arrays import decode_bfloat16
from probe_kit.runs.layout import MEAN_VIEW
from probe_kit.runs.rows import Rows
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import Direction, ProbeResults, read_directions
from probe_kit.train.samples import is_token_view

Values = NDArray[np.float64]


@dataclass(frozen=True)
class EpisodeLogOdds:
    """values: (K, S) log-odds that the correct side is the answer, by captured inference and site.

    held_out: whether no probe that gave them was trained on the episode's item. NaN where the inference is a later
    one, and its activations are left out, or lack the view of the probe.
    """

    values: Values
    held_out: bool


@dataclass(frozen=True)
class _StreamProbes:
    """The probes of one stream. places: of its sites among all. weights: (S, F, D). intercepts: (S, F)."""

    places: list[int]
    at: tuple[list[int], ...]
    view: int
    weights: Values
    intercepts: Values


class FrozenProbes:
    """The probes of one category in one view, and the log-odds that they give to episodes of `run`.

    An episode takes the probe of the fold that tests its item. One whose item no fold tests takes the mean of the
    folds' log-odds, and is then not held out in the sense of the scores. results: of `run`, or of another run of
    the same model. readings: None for probes of `run` itself, whose stored log-odds are taken.
    Of another run the first log-odds that were computed so far, by number of the episode.
    """

    def __init__(
        self, run: Run, results: ProbeResults, category: str, view: str, readings: dict[int, Values] | None = None
    ) -> None:
        self.run, self.curve = run, results.curves[category, view]
        self._kept = readings
        self._results, self._category, self._view = results, category, view
        self._fold_of = dict(zip(self.curve.items.tolist(), self.curve.fold_of.tolist(), strict=True))
        self._place_of = {name: column for column, name in enumerate(self.curve.episodes.tolist())}

    @property
    def sites(self) -> Sequence[Site]:
        """S of them, as in the curve."""
        return self.curve.sites

    def first(self, position: int) -> Values:
        """(S,) log-odds of the episode in row `position` at the inference of the probes, as `log_odds` has them.

        Those of the run's own probes are the stored out-of-fold ones; NaN for an episode without any.
        """
        row = self.run.episodes.iloc[position]
        if self._kept is None:
            return self._stored(str(row["episode_id"]), str(row["side_correct"]))
        number = int(row["episode"])
        if number not in self._kept:
            values = self.log_odds(position).values
            self._kept[number] = values[0] if len(values) else np.full(len(self.sites), np.nan)
        return self._kept[number]

    def _stored(self, episode: str, side_correct: str) -> Values:
        column = self._place_of.get(episode)
        if column is None:
            return np.full(len(self.sites), np.nan)
        return np.asarray(self.curve.decisions[:, column] * toward(side_correct))

    def log_odds(self, position: int) -> EpisodeLogOdds:
        """Return the log-odds of the episode in row `position`, at every captured inference that it reached."""
        row = self.run.episodes.iloc[position]
        side, item = str(row["side_correct"]), str(row["item_id"])
        calls = int(self._calls[position])
        log_odds = np.full((calls, len(self.sites)), np.nan)
        fold = self._fold_of.get(item)
        if not self._reads_activations:
            if self._kept is None:
                log_odds[:1] = self._stored(str(row["episode_id"]), side)
            return EpisodeLogOdds(log_odds, fold is not None)
        for stream, probes in self._streams.items():
            features = self._features(stream, probes, position, calls)
            if fold is None:
                values = (np.einsum("ksd,sfd->ksf", features, probes.weights) + probes.intercepts).mean(axis=-1)
            else:
                values = np.einsum("ksd,sd->ks", features, probes.weights[:, fold]) + probes.intercepts[:, fold]
            log_odds[:, probes.places] = values * toward(side)
        return EpisodeLogOdds(log_odds, fold is not None)

    def _features(self, stream: str, probes: _StreamProbes, position: int, calls: int) -> Values:
        """(K, S, D) of the view at every captured inference; NaN where the view is not stored of it."""
        sites: tuple[Any, ...] = (slice(None), *probes.at)
        first: Values = self._rows[stream][position][:calls][(*sites, probes.view)].astype(np.float64)
        if len(first) == calls:
            return first
        later = np.full((calls - 1, *first.shape[1:]), np.nan)
        if self._view == MEAN_VIEW:
            stored = decode_bfloat16(self.run.rows(stream, "later")[position][: calls - 1])
            later = stored[sites].astype(np.float64)
        return np.concatenate([first, later])

    @property
    def _reads_activations(self) -> bool:
        left_out = any(f"{site.stream}/pooled" in self.run.root.left_out for site in self.sites)
        return not (left_out or is_token_view(self._view))

    @cached_property
    def _calls(self) -> NDArray[np.intp]:
        return count_inferences(self.run)

    @cached_property
    def _rows(self) -> dict[str, Rows]:
        return {stream: self.run.rows(stream) for stream in self._streams}

    @cached_property
    def _streams(self) -> dict[str, _StreamProbes]:
        names = [(self._category, self._view, site) for site in self.sites]
        directions = read_directions(self._results.directions, names)
        streams = {}
        for stream in dict.fromkeys(site.stream for site in self.sites):
            places = [index for index, site in enumerate(self.sites) if site.stream == stream]
            stream_directions = [directions[names[index]] for index in places]
            streams[stream] = self._stacked(stream, places, stream_directions)
        return streams

    def _stacked(self, stream: str, places: list[int], directions: list[Direction]) -> _StreamProbes:
        stored = self.run.stored(stream)
        indices = [stored.at(self.sites[index]) for index in places]
        return _StreamProbes(
            places,
            tuple(list(axis) for axis in zip(*indices, strict=True)),
            stored.views.index(resolve_view(self._view, stored.views)),
            np.stack([direction.weights.astype(np.float64) for direction in directions]),
            np.stack([np.asarray(direction.intercepts, np.float64) for direction in directions]),
        )


def count_inferences(run: Run) -> NDArray[np.intp]:
    """(E,) how many captured inferences every episode reached."""
    counts = np.zeros(len(run.episodes), np.intp)
    for call in range(run.captured_calls):
        counts += run.reached(call)
    return counts


def toward(side_correct: str) -> float:
    """Return the sign that turns a log-odds of `left` into one of the correct side."""
    return 1.0 if side_correct == "left" else -1.0


def decisions_toward_correct(curve: ProbeCurve, places: Sequence[int], sides: Sequence[str]) -> Values:
    """(S, E) held-out log-odds of some episodes of the curve, the correct side up; sides: (E,) the correct."""
    return np.asarray(curve.decisions[:, places] * np.array([toward(side) for side in sides]))
