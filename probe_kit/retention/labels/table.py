"""The retention table of a label: a row per run and view, in the formats of every retention table."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import nan
from typing import TYPE_CHECKING, Any

from probe_kit._system.counting import counted
from probe_kit._system.escaping import csv_of_frame
from probe_kit._tables.formats import render
from probe_kit._tables.numbers import number, with_limits
from probe_kit._tables.table import Heading, Table, grouped
from probe_kit._terminal.plain_text import without_places
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.behaviour.run_labels import full_names
from probe_kit.retention.choices import Family
from probe_kit.retention.estimators.retention import Iterations
from probe_kit.retention.labels.estimate import (
    LabelPeak,
    LabelRetention,
    check_same_label,
    measure_label_retention,
    with_corrected_p,
)
from probe_kit.statistics.paired_tests import holm
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.choices import SIDES
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import load_results, stored_targets

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Group

_NOTE = (
    "above chance: score of the sites that the inner folds choose, on the outer folds, minus its mean score with "
    "permuted labels; 95 % intervals over groups; ✓: signal, above chance and every control that was run"
)
_SIGNAL = " ✓"
"""Behind a score above chance and every control that was run."""
_NAMED = 8
"""Labels of a run that a sentence names."""


@dataclass(frozen=True)
class LabelRow:
    """Retention of a label in one run and view. run: what tables call it. settings: key of its probes."""

    run: str
    location: str
    settings: str
    retention: LabelRetention


@dataclass(frozen=True, repr=False)
class LabelRetentionTable:
    """Rows per target, run and view; no row is a mean, as labels of different tasks have different metrics.

    results: the probes that they were made of, by location and target. tried: by location, all label columns of
    which the run has probes, with the number of versions of their values. family: which tests the signal is
    corrected for.
    """

    rows: tuple[LabelRow, ...]
    results: Mapping[tuple[str, str], ProbeResults] = field(default_factory=dict)
    iterations: Iterations = "all"
    tried: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    family: Family = "label"

    @property
    def targets(self) -> tuple[str, ...]:
        """The label columns, in order."""
        return tuple(dict.fromkeys(row.retention.target for row in self.rows))

    @property
    def has_categories(self) -> bool:
        """Whether any label was probed by category."""
        return any(row.retention.category != "all" for row in self.rows)

    def __repr__(self) -> str:
        names = ", ".join(dict.fromkeys(f"{row.retention.target} of {row.run}" for row in self.rows))
        return f"<LabelRetentionTable of {names}; print(table.to_markdown()) shows it>"

    def of_target(self, target: str) -> "LabelRetentionTable":
        """The rows of one label; p stays as it is."""
        rows = tuple(row for row in self.rows if row.retention.target == target)
        results = {name: probes for name, probes in self.results.items() if name[1] == target}
        return replace(self, rows=rows, results=results, tried={})

    @property
    def text(self) -> Table:
        """The table as text."""
        first, several = self.rows[0].retention, len(self.targets) > 1
        names = ["label", "metric"] * several + ["category"] * self.has_categories + ["run", "view"]
        of_stream = "score", "chance", "above chance"
        headings = (
            *map(Heading, names),
            *grouped(("backbone", ("backbone site", *of_stream)), ("action", ("action site", *of_stream))),
            Heading("retention"),
        )
        rows = []
        for row in self.rows:
            estimate = row.retention
            name = (
                [estimate.target, estimate.metric] * several
                + [estimate.category] * self.has_categories
                + [row.run, estimate.view]
            )
            rows.append((*name, *_peak(estimate.backbone), *_peak(estimate.action), _value(estimate)))
        what = "Labels" if several else f"{first.target}: {first.metric}"
        return Table.of(f"{what}, and what reaches the action", headings, rows, names=len(names), notes=[_NOTE])

    @property
    def summary(self) -> Table:
        """The table without sites and chance; runs and views where there are several."""
        by_column = {
            "label": [row.retention.target for row in self.rows],
            "category": [row.retention.category for row in self.rows],
            "run": [row.run for row in self.rows],
            "view": [row.retention.view for row in self.rows],
        }
        columns = [name for name, cells in by_column.items() if name == "label" or len(set(cells)) > 1]
        return Table.of(
            "Labels, and what reaches the action",
            (*columns, "metric", "backbone above chance", "action above chance", "retention"),
            [
                (*(by_column[name][position] for name in columns), row.retention.metric,
                 _above(row.retention.backbone), _above(row.retention.action),
                 _value(row.retention).partition(" (")[0])
                for position, row in enumerate(self.rows)
            ],
            names=len(columns),
            notes=[_NOTE],
        )  # fmt: skip

    @property
    def sentences(self) -> list[str]:
        """One per row: what reaches the action, or why that has no number. Then how many labels were tried."""
        several = len({location for location, _ in self.results}) > 1
        return [*(_sentence(row, several) for row in self.rows), *self._uncontrolled(), *self._tried()]

    def _uncontrolled(self) -> list[str]:
        """A warning where a signal was compared with no control."""
        if not (bare := [row for row in self.rows if not row.retention.backbone.exceeds]):
            return []
        names = ", ".join(dict.fromkeys(f"{row.retention.target} of {row.run}" for row in bare))
        return [f"No control was run for {names}: a signal there is judged against chance only."]

    def _tried(self) -> list[str]:
        """Return what the p-values are corrected for, wherever a run has probes of several labels."""
        names = {row.location: row.run for row in self.rows}
        sentences = []
        for location, targets in self.tried.items():
            if (count := sum(targets.values())) > 1:
                targets_in_words = [f"{name} in {of} versions" if of > 1 else name for name, of in targets.items()]
                listed = ", ".join([*targets_in_words[:_NAMED], *["…"] * (len(targets_in_words) > _NAMED)])
                corrected = "of each label alone" if self.family == "label" else (
                    f"corrected for the {len(self.targets)} labels of this table (Holm)"
                )  # fmt: skip
                sentences.append(f"{names[location]} has probes of {count} labels ({listed}); p is {corrected}.")
        return sentences

    def to_frame(self) -> "pd.DataFrame":
        """One line per row with the fields of `LabelRetention`, of its streams as `backbone.score` and so on.

        Intervals become two columns. Retention is NaN where it is not defined; `to_json` keeps the ratio.
        """
        import pandas as pd

        return pd.DataFrame([_flat(row) for row in self.rows])

    def to_json(self) -> str:
        """All rows as a JSON list of objects."""
        return json.dumps([_plain(asdict(row)) for row in self.rows], indent=2, ensure_ascii=False)

    def to_csv(self) -> str:
        """`to_frame` as comma-separated values with a header."""
        return csv_of_frame(self.to_frame())

    def to_text(self, style: str) -> str:
        """The table and its sentences in a format of `probe_kit._tables.formats`."""
        return render(style, [self.text], self.sentences)

    def to_markdown(self) -> str:
        """The table and its sentences in Markdown."""
        return self.to_text("markdown")

    def to_latex(self) -> str:
        """The table in LaTeX; needs the package booktabs."""
        return self.to_text("latex")

    def to_rich(self) -> "Group":
        """The table for a rich console, and a sentence per row."""
        from rich.console import Group
        from rich.text import Text

        return Group(self.text, *map(Text, self.sentences))

    def _repr_html_(self) -> str:
        from markupsafe import Markup

        entries = Markup("").join(
            Markup("<li>{}</li>").format(without_places(sentence)) for sentence in self.sentences
        )
        return f"{self.text._repr_html_()}<ul>{entries}</ul>"


def label_retention_table(
    runs: Sequence[RunReader],
    targets: str | Sequence[str],
    views: Sequence[str] | None = None,
    *,
    iterations: Iterations = "all",
    keys: Sequence[str | None] | None = None,
    family: Family = "label",
) -> LabelRetentionTable:
    """Retention of one label or several in runs whose probes of them are stored; see `measure_label_retention`.

    views: those that were probed by default. keys: which stored probes of each run, in order; those asked for last
    by default; with one target only. family: `table` corrects p for all targets by Holm's method, per run, view
    and stream. Raises NoProbesError for a run without probes of a label, UsageError for several runs whose
    labels differ, a target given twice, and keys of another target, and what `measure_label_retention` raises.
    """
    columns = [targets] if isinstance(targets, str) else list(targets)
    if not runs or not columns:
        raise UsageError("retention of a label needs at least one run and one target")
    if sides := [name for name in columns if name in SIDES]:
        raise UsageError(
            f"the target {sides[0]!r} is the name of a side. Leave --target out for the retention of sides"
        )
    if doubles := [name for at, name in enumerate(columns) if name in columns[:at]]:
        raise UsageError(f"the target {doubles[0]!r} is given twice; leave one out")
    key_of_run = list(keys or [None] * len(runs))
    if len(key_of_run) != len(runs):
        raise UsageError(f"{len(key_of_run)} keys for {len(runs)} runs; give one per run, or None for the newest")
    if len(columns) > 1 and any(key_of_run):
        raise UsageError(
            f"stored probes are chosen by key for {len(columns)} targets ({', '.join(columns)}); a key is of one. "
            "Show one target at a time, or leave the keys out"
        )
    places = [str(run.location) for run in runs]
    results: dict[tuple[str, str], ProbeResults] = {}
    for target in columns:
        of_target = [load_results(run, key, target) for run, key in zip(runs, key_of_run, strict=True)]
        check_same_label(of_target, places)
        results |= {(location, target): probes for location, probes in zip(places, of_target, strict=True)}
    names = dict(zip(places, full_names(runs), strict=True))
    rows = [
        LabelRow(
            names[location], location, probes.key, measure_label_retention(probes, view, iterations, category)
        )
        for (location, _), probes in results.items()
        for category in probes.settings.categories
        for view in views or probes.settings.views
    ]
    tried = {location: stored_targets(run) for location, run in zip(places, runs, strict=True)}
    corrected = rows if family == "label" else _corrected(rows, results)
    return LabelRetentionTable(tuple(corrected), results, iterations, tried, family)


def _corrected(rows: Sequence[LabelRow], results: Mapping[tuple[str, str], ProbeResults]) -> list[LabelRow]:
    """The rows with p of both streams corrected for the targets, within each run and view."""
    families: dict[tuple[str, str, str], list[int]] = {}
    for position, row in enumerate(rows):
        families.setdefault((row.location, row.retention.category, row.retention.view), []).append(position)
    corrected = list(rows)
    for members in families.values():
        estimates = [rows[position].retention for position in members]
        p = [
            holm([None if peak.p_fwe != peak.p_fwe else peak.p_fwe for peak in peaks])
            for peaks in (
                [estimate.backbone for estimate in estimates],
                [estimate.action for estimate in estimates],
            )
        ]
        for position, estimate, backbone, action in zip(members, estimates, *p, strict=True):
            probes = results[rows[position].location, estimate.target]
            corrected[position] = replace(
                rows[position], retention=with_corrected_p(estimate, probes, backbone, action, len(members))
            )
    return corrected


def _peak(peak: LabelPeak) -> tuple[str, str, str, str]:
    score = f"{number(peak.score)}{_SIGNAL * peak.is_marked}"
    chance = "–" if peak.chance != peak.chance else number(peak.chance)
    return peak.site, score, chance, _above(peak).removesuffix(_SIGNAL)


def _above(peak: LabelPeak) -> str:
    """Score above chance with its interval, marked where there is signal."""
    if peak.chance != peak.chance:
        return "–"
    return with_limits(peak.above, peak.ci, number) + _SIGNAL * peak.is_marked


def _value(estimate: LabelRetention) -> str:
    return with_limits(estimate.value, estimate.ci, number) if estimate.defined else estimate.note


def _sentence(row: LabelRow, several: bool) -> str:
    estimate = row.retention
    where = f"{estimate.target}, view {estimate.view}" + (f", {row.run}" if several else "")
    where += "" if estimate.category == "all" else f", category {estimate.category}"
    if not estimate.defined:
        return f"{where}: retention is not defined: {estimate.reason}."
    action = label_of(estimate.action.stream)
    limits = with_limits(estimate.value, estimate.ci, number)
    missed = estimate.action.missed
    reached = f"not shown to exceed {', '.join(missed)}" if missed else f"signal there (p < {SIGNIFICANCE})"
    return (
        f"{where}: {limits} of the backbone's score above chance is left in the {action}; {reached}. "
        f"{counted(estimate.n_groups, 'group')}, {counted(estimate.n_samples, 'sample')}."
    )


def _flat(row: LabelRow) -> dict[str, Any]:
    """Fields of a row; nested names are joined by a dot."""
    estimate = row.retention
    line: dict[str, Any] = {
        "run": row.run,
        "target": estimate.target,
        "task": estimate.task,
        "metric": estimate.metric,
    }
    line |= {"category": estimate.category, "view": estimate.view}
    for name, peak in (("backbone", estimate.backbone), ("action", estimate.action)):
        low, high = peak.ci
        line |= {
            f"{name}.stream": peak.stream, f"{name}.site": peak.site, f"{name}.score": peak.score,
            f"{name}.chance": peak.chance, f"{name}.p_fwe": peak.p_fwe, f"{name}.above": peak.above,
            f"{name}.ci_low": low, f"{name}.ci_high": high,
            **{f"{name}.exceeds.{control}": better for control, better in peak.exceeds.items()},
        }  # fmt: skip
    low, high = estimate.ci
    line |= {
        "retention": estimate.value if estimate.defined else nan,
        "retention.ci_low": low if estimate.defined and low is not None else nan,
        "retention.ci_high": high if estimate.defined and high is not None else nan,
        "note": estimate.note, "reason": estimate.reason, "n_groups": estimate.n_groups,
        "n_samples": estimate.n_samples,
        "settings": row.settings,
    }  # fmt: skip
    return line


def _plain(value: Any) -> Any:
    """Return the value as JSON has it: without NaN."""
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and value != value else value
