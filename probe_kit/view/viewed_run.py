"""A run as the viewer shows it: its rows of the retention table, its probes, and a name for addresses."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.kinds.attention import PatchAttention, stored_patch_attention
from probe_kit.intervene.settings import has_sides
from probe_kit.retention import RetentionRow, RetentionTable, retention_table
from probe_kit.retention.behaviour import ask_of
from probe_kit.runs import Run
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import how_to_probe, load_results, load_results_by_call, stored_targets
from probe_kit.view.frozen_probes import FrozenProbes, Values, count_inferences

UNREAD = "unread"
_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")


@dataclass(frozen=True)
class ViewedRun:
    """A run, opened in one wording. key: its name in addresses and folders, unique among the runs of a page.

    lender: a run of the same model whose probes are shown where this one has none. readings: first log-odds by
    category and number of the episode that these probes gave so far.
    """

    key: str
    run: Run
    lender: "ViewedRun | None" = None
    readings: dict[str, dict[int, Values]] = field(default_factory=dict)

    @property
    def has_sides(self) -> bool:
        """Whether answers lie on a side, as in the scene; other runs have no retention table."""
        return has_sides(self.run)

    @cached_property
    def table(self) -> RetentionTable:
        """The retention table of this run alone, without the columns that no page shows and that take longest."""
        return retention_table([self.run], with_behaviour=False)

    @property
    def places(self) -> tuple[str, str]:
        """Return the run's names on this machine, which no page shows."""
        return self.run.location.address, str(self.run.location)

    @property
    def own_results(self) -> ProbeResults | None:
        """The probes of the table; None without any."""
        return self.table.results_of(self.run.location) if self.has_sides else None

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
        """The rows of the table that say which sites of the shown probes are best, by category."""
        return self.lender.rows if self.lender is not None and self.is_lent else self.rows

    @property
    def view(self) -> str | None:
        """The view whose probes are shown: the first one that was probed."""
        return None if self.results is None else self.results.settings.views[0]

    @cached_property
    def captured_inferences(self) -> NDArray[np.intp]:
        """(E,) how many captured inferences every episode reached."""
        return count_inferences(self.run)

    @property
    def answers(self) -> bool:
        """Whether the model was asked and did not act."""
        return ask_of(self.run) is not None

    def outcome_word(self, outcome: Any) -> Any:
        """The outcome as the page names it: `unread` where no rule could read the answer of a VLM, not `oob`."""
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
        """Return the categories in the order of the episodes."""
        return tuple(dict.fromkeys(self.run.episodes["category"].astype(str)))

    @property
    def probed_categories(self) -> tuple[str, ...]:
        """Return the categories that have probes in the view that is shown."""
        return tuple(category for category in self.categories if self.curve(category) is not None)

    def curve(self, category: str) -> ProbeCurve | None:
        """The probes of a category, None without any."""
        if self.results is None or self.view is None:
            return None
        return self.results.curves.get((category, self.view))

    @cached_property
    def patch_attention(self) -> dict[str, PatchAttention]:
        """Return by category the stored attention on the patches of the cameras' pictures."""
        return stored_patch_attention(self.run)

    @cached_property
    def target_curves(self) -> list[tuple[ProbeResults, str]]:
        """Results and category of every target but the sides that was probed, in the first view of its probes."""
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
        """Return by captured inference the probes that were fitted to it with otherwise equal settings."""
        return {} if self.own_results is None else load_results_by_call(self.run, self.own_results)

    @cached_property
    def probes(self) -> dict[str, FrozenProbes]:
        """Return by category the probes of the table's inference."""
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
    """The runs as the viewer shows them: of several wordings the first, as in `retention_table`.

    probes_of: a run whose probes are shown where a run of the same model has none. Raises UsageError without runs,
    if one is given twice, or if `probes_of` has no probes or is of another model than all runs without probes.
    """
    if not runs:
        raise UsageError("the viewer needs at least one run")
    places = [run.location.address for run in runs]
    if doubles := [address for at, address in enumerate(places) if address in places[:at]]:
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
    """Why probes of `lender` cannot read the activations of `run`; None if they can."""
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
    return next(key for key in numbered if key.lower() not in {other.lower() for other in used})
