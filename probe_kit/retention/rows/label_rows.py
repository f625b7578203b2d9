"""Rows of targets that are no side: a row per target, run, category and view, from stored probes."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from probe_kit._system.counting import counted
from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.retention.behaviour.success_rate import SuccessRate
from probe_kit.retention.choices import Family, Iterations
from probe_kit.retention.rows.build import run_info
from probe_kit.retention.rows.probe_parts import with_corrected_p, with_probes
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.paired_tests import holm
from probe_kit.train.choices import SIDES
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import load_results, stored_targets

Results = Mapping[tuple[str, str], ProbeResults]
"""By the location of a run and the target."""
_NAMED = 8
"""Labels of a run that a sentence names."""


def read_labels(
    runs: Sequence[RunReader], targets: Sequence[str], keys: Sequence[str | None]
) -> dict[tuple[str, str], ProbeResults]:
    """Return the stored probes of every target in every run.

    keys: which ones of each run, the newest by default; with one target only. Raises NoProbesError for a run
    without probes of a target, UsageError for a side, a target given twice, a key of another target, and several
    runs whose labels differ.
    """
    if sides := [name for name in targets if name in SIDES]:
        raise UsageError(
            f"the target {sides[0]!r} is the name of a side. Leave --target out for the retention of sides"
        )
    if doubles := [name for at, name in enumerate(targets) if name in targets[:at]]:
        raise UsageError(f"the target {doubles[0]!r} is given twice; leave one out")
    if len(targets) > 1 and any(keys):
        raise UsageError(
            f"stored probes are chosen by key for {len(targets)} targets ({', '.join(targets)}); a key is of one. "
            "Show one target at a time, or leave the keys out"
        )
    results: dict[tuple[str, str], ProbeResults] = {}
    for target in targets:
        of_target = [load_results(run, key, target) for run, key in zip(runs, keys, strict=True)]
        _check_same_label(of_target, runs)
        results |= {(str(run.location), target): of_run for run, of_run in zip(runs, of_target, strict=True)}
    return results


def _check_same_label(results: Sequence[ProbeResults], runs: Sequence[RunReader]) -> None:
    """Raise UsageError where results of two runs are of labels that differ in any value or sample."""
    first = results[0]
    for of_run, run in zip(results, runs, strict=True):
        if of_run.settings.label != first.settings.label:
            raise UsageError(
                f"the labels {of_run.settings.target!r} of {run.location} and {runs[0].location} differ "
                f"(sha256 {of_run.settings.label[:12]} and {first.settings.label[:12]}); retention is compared on "
                "the same labels of the same episodes. Show the runs one by one"
            )


def label_rows(
    runs: Sequence[RunReader],
    results: Results,
    views: Sequence[str] | None = None,
    iterations: Iterations = "all",
    family: Family = "label",
) -> list[RetentionRow]:
    """Return a row per target, run, category and view; views: those that were probed by default.

    family: `table` corrects p for all targets by Holm's method, per run, category, view and stream. Raises
    UnknownSiteError for a view that was not probed, UsageError for an iteration that the action does not have.
    """
    run_of = {str(run.location): run for run in runs}
    rows = [
        target_row(run_of[location], probes, category, view, iterations)
        for (location, _), probes in results.items()
        for category in probes.settings.categories
        for view in views or probes.settings.views
    ]
    return rows if family == "label" else _corrected(rows, results)


def target_row(
    run: RunReader, results: ProbeResults, category: str, view: str, iterations: Iterations = "all"
) -> RetentionRow:
    """Return the row of a target, also of a side, in one category and view, without success.

    Raises UnknownSiteError if it was not probed.
    """
    settings = results.settings
    if (category, view) not in results.curves:
        raise UnknownSiteError(f"view {view!r} was not probed; probed: {', '.join(settings.views)}")
    curve = results.curves[category, view]
    row = RetentionRow(
        category=category,
        view=view,
        target=settings.target,
        task=settings.task,
        run=run_info(run, results),
        success=SuccessRate(n_episodes=np.unique(curve.episodes).size, n_items=np.unique(curve.items).size),
    )
    return with_probes(row, results, iterations, seed_text=settings.seed_text)[0]


def _corrected(rows: Sequence[RetentionRow], results: Results) -> list[RetentionRow]:
    """Return the rows with p of both streams corrected for the targets, within each run, category and view."""
    families: dict[tuple[str, str, str | None], list[int]] = {}
    for number, row in enumerate(rows):
        families.setdefault((row.run.location, row.category, row.view), []).append(number)
    corrected = list(rows)
    for members in families.values():
        p = [holm([getattr(rows[at], part).p_fwe for at in members]) for part in ("backbone", "action")]
        for at, backbone, action in zip(members, *p, strict=True):
            probes = results[rows[at].run.location, rows[at].target]
            corrected[at] = with_corrected_p(rows[at], probes, backbone, action, len(members))
    return corrected


# -- what a reader must know ---------------------------------------------------------------------------------


def label_notes(
    runs: Sequence[RunReader], rows: Sequence[RetentionRow], family: Family, names: Mapping[str, str]
) -> Iterator[str]:
    """Yield a warning where a signal was compared with no control, and how many labels were tried in each run.

    names: of the runs, by location.
    """
    bare = [row for row in rows if row.backbone.peak is not None and not row.backbone.is_controlled]
    if bare:
        of_runs = ", ".join(dict.fromkeys(f"{row.target} of {names[row.run.location]}" for row in bare))
        yield f"No control was run for {of_runs}: a signal there is judged against chance only."
    count = len({row.target for row in rows})
    corrected = (
        "of each label alone" if family == "label" else f"corrected for the {count} labels of this table (Holm)"
    )
    for run in runs:
        tried = stored_targets(run)
        if sum(tried.values()) > 1:
            yield f"{names[str(run.location)]} has probes of {_in_words(tried)}; p is {corrected}."


def _in_words(tried: Mapping[str, int]) -> str:
    """Return how many labels a run has probes of; one whose values changed counts again."""
    words = [f"{name} in {of} versions" if of > 1 else name for name, of in tried.items()]
    first = ", ".join([*words[:_NAMED], *["…"] * (len(words) > _NAMED)])
    return f"{counted(sum(tried.values()), 'label')} ({first})"
