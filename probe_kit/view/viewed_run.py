"""A run in the form of the viewer: its rows of the retention table, a name for addresses, and its probes.

Probes of one inference are applied to every captured inference of an episode, held out by fold.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import Site, resolve_view
from probe_kit.intervene.kinds.attention import PatchAttention, stored_patch_attention
from probe_kit.retention import RetentionRow, RetentionTable, retention_table
from probe_kit.runs import Run
from probe_kit.runs.arrays import EpisodeRows, decode_bfloat16
from probe_kit.runs.layout import MEAN_VIEW
from probe_kit.runs.reader import reached_calls
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults, read_directions
from probe_kit.train.results.store import how_to_probe, load_results, load_results_by_call, stored_targets
from probe_kit.train.samples import is_token_view


@dataclass(frozen=True)
class _StreamProbes:
    """The probes of one stream, at S sites with F folds.

    Attributes:
        positions: Positions of its sites among all.
        weights: (S, F, D).
        intercepts: (S, F).
    """

    positions: list[int]
    at: tuple[list[int], ...]
    view: int
    weights: Matrix
    intercepts: Matrix


class FrozenProbes:
    """The probes of one category in one view, and the log-odds that they give to episodes of `run`.

    An episode takes the probe of the fold that tests its item. One whose item no fold tests takes the mean of the
    folds' log-odds, and is then not held out in the sense of the scores.

    Args:
        run: The run whose episodes are read.
        results: Probes of `run`, or of another run of the same model.
        category: Category of the probes.
        view: View of the probes.
        readings: None for probes of `run` itself, whose stored log-odds are taken. For another run's probes, the
            first log-odds that were computed so far, by number of the episode.
    """

    def __init__(
        self, run: Run, results: ProbeResults, category: str, view: str, readings: dict[int, Matrix] | None = None
    ) -> None:
        self.run, self.curve = run, results.curves[category, view]
        self._readings = readings
        self._results, self._category, self._view = results, category, view
        self._fold_of = dict(zip(self.curve.items.tolist(), self.curve.fold_of.tolist(), strict=True))
        self._place_of = {name: column for column, name in enumerate(self.curve.episodes.tolist())}

    @property
    def sites(self) -> Sequence[Site]:
        """The S sites, in the order of the curve."""
        return self.curve.sites

    def first(self, position: int) -> Matrix:
        """Return the log-odds (S,) of the episode in row `position` at the inference of the probes.

        They are those of `log_odds`. Of the run's own probes they are the stored out-of-fold ones; NaN for an
        episode without any.
        """
        row = self.run.episodes.iloc[position]
        if self._readings is None:
            return self._stored_matrix(str(row["episode_id"]), str(row["side_correct"]))
        number = int(row["episode"])
        if number not in self._readings:
            values, _ = self.log_odds(position)
            self._readings[number] = values[0] if len(values) else np.full(len(self.sites), np.nan)
        return self._readings[number]

    def _stored_matrix(self, episode: str, side_correct: str) -> Matrix:
        column = self._place_of.get(episode)
        if column is None:
            return np.full(len(self.sites), np.nan)
        return np.asarray(self.curve.decisions[:, column] * toward(side_correct))

    def log_odds(self, position: int) -> tuple[Matrix, bool]:
        """Return the log-odds (K, S) of the episode in row `position`, by captured inference and site.

        Only the inferences that the episode reached are in it. Log-odds are toward the correct side. They are NaN
        where the inference is a later one, and its activations are left out, or lack the view of the probe. The
        flag tells whether no probe that gave them was trained on the episode's item.
        """
        row = self.run.episodes.iloc[position]
        side, item = str(row["side_correct"]), str(row["item_id"])
        calls = int(self._calls[position])
        log_odds = np.full((calls, len(self.sites)), np.nan)
        # The fold that tests the item: its probe has seen neither the item nor its group.
        fold = self._fold_of.get(item)
        if not self._reads_activations:
            if self._readings is None:
                log_odds[:1] = self._stored_matrix(str(row["episode_id"]), side)
            return log_odds, fold is not None
        for stream, probes in self._streams.items():
            features = self._features(stream, probes, position, calls)
            if fold is None:
                values = (np.einsum("ksd,sfd->ksf", features, probes.weights) + probes.intercepts).mean(axis=-1)
            else:
                values = np.einsum("ksd,sd->ks", features, probes.weights[:, fold]) + probes.intercepts[:, fold]
            log_odds[:, probes.positions] = values * toward(side)
        return log_odds, fold is not None

    def _features(self, stream: str, probes: _StreamProbes, position: int, calls: int) -> Matrix:
        """Return the view (K, S, D) at every captured inference; NaN where it is not stored."""
        sites: tuple[Any, ...] = (slice(None), *probes.at)
        first: Matrix = self._rows[stream][position][:calls][(*sites, probes.view)].astype(np.float64)
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
        return np.asarray(reached_calls(self.run).sum(axis=1))

    @cached_property
    def _rows(self) -> dict[str, EpisodeRows]:
        return {stream: self.run.rows(stream) for stream in self._streams}

    @cached_property
    def _streams(self) -> dict[str, _StreamProbes]:
        names = [(self._category, self._view, site) for site in self.sites]
        directions = read_directions(self._results.directions, names)
        streams = {}
        for stream in dict.fromkeys(site.stream for site in self.sites):
            stored = self.run.stored(stream)
            positions = [index for index, site in enumerate(self.sites) if site.stream == stream]
            indices = [stored.at(self.sites[index]) for index in positions]
            probes = [directions[names[index]] for index in positions]
            streams[stream] = _StreamProbes(
                positions,
                tuple(list(axis) for axis in zip(*indices, strict=True)),
                stored.views.index(resolve_view(self._view, stored.views)),
                np.stack([probe.weights.astype(np.float64) for probe in probes]),
                np.stack([np.asarray(probe.intercepts, np.float64) for probe in probes]),
            )
        return streams


def toward(side_correct: str) -> float:
    """Return the sign that turns a log-odds of `left` into one of the correct side."""
    return 1.0 if side_correct == "left" else -1.0


def decisions_toward_correct(curve: ProbeCurve, positions: Sequence[int], sides: Sequence[str]) -> Matrix:
    """Return the held-out log-odds (S, E) of some episodes of the curve, the correct side up.

    Args:
        curve: Probes of one category in one view.
        positions: Positions of the E episodes in the curve.
        sides: (E,) the correct sides.
    """
    return np.asarray(curve.decisions[:, positions] * np.array([toward(side) for side in sides]))


# -- the run -----------------------------------------------------------------------------------------------------


UNREAD = "unread"
_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")


@dataclass(frozen=True)
class ViewedRun:
    """A run, opened in one wording.

    Attributes:
        key: Its name in addresses and folders, unique among the runs of a page.
        lender: A run of the same model whose probes are shown where this one has none.
        readings: First log-odds by category and number of the episode that these probes gave so far.
    """

    key: str
    run: Run
    lender: "ViewedRun | None" = None
    readings: dict[str, dict[int, Matrix]] = field(default_factory=dict)

    @cached_property
    def table(self) -> RetentionTable:
        """The retention table of this run alone, without the columns that no page shows and that take longest."""
        return retention_table([self.run], with_behaviour=False)

    @property
    def paths(self) -> tuple[str, str]:
        """The run's names on this machine, which no page shows."""
        return self.run.location.address, str(self.run.location)

    @property
    def own_results(self) -> ProbeResults | None:
        """The probes of the table; None without any."""
        return self.table.results_of(self.run.location) if self.run.source.is_scene else None

    @property
    def is_lent(self) -> bool:
        """Whether the probes that are shown are those of another run."""
        return self.lender is not None and self.own_results is None

    @property
    def results(self) -> ProbeResults | None:
        """The probes that are shown; None without any."""
        return self.lender.own_results if self.lender is not None and self.is_lent else self.own_results

    @property
    def probed_rows(self) -> Mapping[str, RetentionRow]:
        """The rows of the table that name the best sites of the shown probes, by category."""
        return self.lender.rows if self.lender is not None and self.is_lent else self.rows

    @property
    def view(self) -> str | None:
        """The view whose probes are shown: the first one that was probed."""
        return None if self.results is None else self.results.settings.views[0]

    @cached_property
    def captured_inferences(self) -> NDArray[np.intp]:
        """The number (E,) of captured inferences that every episode reached."""
        return np.asarray(reached_calls(self.run).sum(axis=1))

    @property
    def answers(self) -> bool:
        """Whether the model was asked and did not act."""
        return self.run.ask is not None

    def outcome_word(self, outcome: Any) -> Any:
        """Return the page's name of the outcome.

        It is `unread` instead of `oob` where no rule could read the answer of a VLM.
        """
        return UNREAD if self.answers and outcome == "oob" else outcome

    @cached_property
    def rows(self) -> dict[str, RetentionRow]:
        """The table's row of every category, in the view that is shown."""
        return {row.category: row for row in self.table.rows if row.view in (None, self.view)}

    @property
    def mean(self) -> RetentionRow:
        """The table's mean over the categories."""
        return next(row for row in self.table.means if row.view in (None, self.view))

    @property
    def categories(self) -> tuple[str, ...]:
        """The categories in the order of the episodes."""
        return tuple(dict.fromkeys(self.run.episodes["category"].astype(str)))

    @property
    def probed_categories(self) -> tuple[str, ...]:
        """The categories that have probes in the view that is shown."""
        return tuple(category for category in self.categories if self.curve(category) is not None)

    def curve(self, category: str) -> ProbeCurve | None:
        """Return the probes of a category, None without any."""
        if self.results is None or self.view is None:
            return None
        return self.results.curves.get((category, self.view))

    @cached_property
    def patch_attention(self) -> dict[str, PatchAttention]:
        """The stored attention on the patches of the cameras' pictures, by category."""
        return stored_patch_attention(self.run)

    @cached_property
    def target_curves(self) -> list[tuple[ProbeResults, str]]:
        """Results and category of every probed target except the sides, in the first view of its probes."""
        results = [load_results(self.run, target=target) for target in stored_targets(self.run)]
        return [
            (probes, category)
            for probes in results
            for category, view in probes.curves
            if view == probes.settings.views[0]
        ]

    @property
    def sites(self) -> tuple[Site, ...]:
        """All probed sites, the same in every category; none without probes."""
        return next((curve.sites for name in self.categories if (curve := self.curve(name)) is not None), ())

    @cached_property
    def refitted(self) -> Mapping[int, ProbeResults]:
        """The probes that were fitted to a captured inference with otherwise equal settings, by inference."""
        return {} if self.own_results is None else load_results_by_call(self.run, self.own_results)

    @cached_property
    def probes(self) -> dict[str, FrozenProbes]:
        """The probes of the table's inference, by category."""
        results, view = self.results, self.view
        if results is None or view is None:
            return {}
        return {
            name: FrozenProbes(
                self.run, results, name, view, self.readings.setdefault(name, {}) if self.is_lent else None
            )
            for name in self.probed_categories
        }

    def inference_steps(self, position: int) -> list[int]:
        """Return the control step, or the recorded frame, of every inference of the episode in a row."""
        steps = self.run.control_steps[position]
        return [int(step) for step in steps[steps >= 0]]

    @cached_property
    def position_of(self) -> dict[int, int]:
        """Row in `run.episodes` by the episode's number."""
        return {int(number): position for position, number in enumerate(self.run.episodes["episode"])}


def view_runs(runs: Sequence[Run], probes_of: Run | None = None) -> list[ViewedRun]:
    """Return the runs in the form of the viewer: of several wordings the first, as in `retention_table`.

    Args:
        runs: The runs of the page.
        probes_of: A run whose probes are shown where a run of the same model has none.

    Raises:
        UsageError: Without runs, if one is given twice, or if `probes_of` has no probes or is of another model
            than all runs without probes.
    """
    if not runs:
        raise UsageError("the viewer needs at least one run")
    paths = [run.location.address for run in runs]
    if doubles := [address for at, address in enumerate(paths) if address in paths[:at]]:
        raise UsageError(f"{doubles[0]} is given twice. Leave one out")
    keys: list[str] = []
    for run in runs:
        keys.append(_key(run.location.name, keys))
    viewed = [ViewedRun(key, run.in_wording()) for key, run in zip(keys, runs, strict=True)]
    return viewed if probes_of is None else _with_lender(viewed, probes_of)


def _with_lender(viewed: Sequence[ViewedRun], probes_of: Run) -> list[ViewedRun]:
    lender = ViewedRun("probes", probes_of.in_wording())
    if lender.own_results is None:
        raise UsageError(f"{probes_of.location} has no probes. {how_to_probe(probes_of)}")
    bare = [candidate for candidate in viewed if candidate.own_results is None and candidate.run.streams]
    fitting = {candidate.key for candidate in bare if _difference(candidate.run, lender) is None}
    if bare and not fitting:
        raise UsageError(
            f"the probes of {probes_of.location} cannot read {bare[0].run.location}: "
            f"{_difference(bare[0].run, lender)}"
        )
    return [replace(candidate, lender=lender) if candidate.key in fitting else candidate for candidate in viewed]


def _difference(run: Run, lender: ViewedRun) -> str | None:
    """Return the reason why probes of `lender` cannot read the activations of `run`; None if they can."""
    other = lender.run
    if run.weights_sha256 != other.weights_sha256:
        return f"it has other weights, {str(run.weights_sha256)[:12]} instead of {str(other.weights_sha256)[:12]}"
    for name in dict.fromkeys(site.stream for site in lender.sites):
        if run.streams.get(name) != other.streams[name] or run.views(name) != other.views(name):
            return f"its stream {name} has other sites or views"
    return None


def _key(name: str, used: Sequence[str]) -> str:
    plain = _UNSAFE.sub("-", name).strip(".-") or "run"
    numbered = (plain if count == 1 else f"{plain}-{count}" for count in range(1, len(used) + 2))
    # Exported pages have a folder per key, and not every file system tells cases apart.
    return next(key for key in numbered if key.lower() not in {other.lower() for other in used})
