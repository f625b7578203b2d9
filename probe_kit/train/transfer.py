"""Probes fitted on all of one run and scored on another: `transfer_probes`, its results, table and sentences."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import plural
from probe_kit._system.table_cells import alike
from probe_kit._system.types import Matrix, Progress
from probe_kit._tables.numbers import p_text
from probe_kit._tables.table import Cell, Table
from probe_kit._terminal.notebook import notebook_progress
from probe_kit.errors import SettingsMismatchError, TooFewGroupsError, UsageError
from probe_kit.hooks.contract.sites import Site, label_of
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.folds import OUTER_FOLDS, Fold
from probe_kit.statistics.label_permutations import p_value
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.choices import EVERYWHERE, Task
from probe_kit.train.crossval.nested_folds import NestedFold
from probe_kit.train.crossval.site_probe import SiteProbe, predict_once, probe_site
from probe_kit.train.crossval.task_scores import METRICS, balanced_scores, score_interval
from probe_kit.train.probe_sweep import (
    TOKEN_PERMUTATIONS,
    ProbeSweep,
    check_options,
    check_run,
)
from probe_kit.train.problem import Problem, make_problem, smallest_p_of_labels
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import best_sites, three_digits
from probe_kit.train.samples import Samples, read_samples, sites_of
from probe_kit.train.solver.arrays import RowSubset
from probe_kit.train.target import Target
from probe_kit.train.target_samples import TargetSamples

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class TransferCurve:
    """The probes of all S sites of one view, on the m samples of the other run.

    Attributes:
        fitted: Probes as they were fitted.
        recentred: The same probes after the other run's features were moved to the mean of the first.
        refitted: (S, m) held-out scores of probes of the other run itself.
    """

    fitted: ProbeCurve
    recentred: ProbeCurve
    refitted: Matrix


@dataclass(frozen=True, repr=False)
class TransferResults:
    """The probes of one label, fitted on one run (`model`) and scored on another (`other_model`).

    Attributes:
        same_weights: Whether both runs are known to be of one network.
        definition: Hash of the label's definition, equal in both runs.
        classes: Classes of the other run's labels.
        labels: (m,) coded labels of the other run.
        episodes: (m,) names of its episodes.
        inferences: (m,) its captured inferences.
        groups: (m,) names of its groups.
        curves: Curves by view.
        smallest_p: Lower bound of every p.
        trained_on: Number of samples and groups of the first run.
        left_out: Number of samples or groups of the other run that were left out, by reason.
    """

    model: str
    other_model: str
    same_weights: bool
    target: str
    task: Task
    definition: str
    classes: tuple[str, ...]
    labels: Matrix
    episodes: NDArray[np.str_]
    inferences: NDArray[np.int64]
    groups: NDArray[np.str_]
    curves: Mapping[str, TransferCurve]
    smallest_p: float
    trained_on: Mapping[str, int]
    left_out: Mapping[str, int]

    def __repr__(self) -> str:
        return (
            f"<TransferResults {self.target} ({self.task}), {self.model} to {self.other_model}; views "
            f"{', '.join(self.curves)}; {self.labels.size} samples, {np.unique(self.groups).size} groups>"
        )

    @cached_property
    def scores(self) -> "pd.DataFrame":
        """One row per view and site.

        `score`, `ci_low`, `ci_high`, `chance`, `p`, `p_fwe`: as in `ProbeResults.scores`, on the other run.
        `recentred`, `recentred_chance`, `recentred_p_fwe`: the same on features moved to the first run's mean.
        `refitted`, `refitted_ci_low`, `refitted_ci_high`: cross-validated score of the other run itself.
        `penalty`: λ, or 1 / C.
        """
        import pandas as pd

        return pd.DataFrame([row for view, curve in self.curves.items() for row in self._rows(view, curve)])

    def _rows(self, view: str, curve: TransferCurve) -> Iterator[dict[str, Any]]:
        fitted, moved = curve.fitted, curve.recentred
        p, p_fwe, moved_p = p_value(fitted.metric, fitted.null), fitted.p_fwe(), moved.p_fwe()
        deviations = (self.labels - self.labels.mean()) ** 2
        for row, (site, part) in enumerate(zip(fitted.sites, fitted.parts, strict=True)):
            low, high = score_interval(fitted.scores[row], self.labels, self.groups, self.task)
            low_refitted, high_refitted = score_interval(
                curve.refitted[row], self.labels, self.groups, self.task, deviations
            )
            yield {
                "model": self.model,
                "other_model": self.other_model,
                "target": self.target,
                "task": self.task,
                "view": view,
                "site": str(site),
                "stream": site.stream,
                "part": part,
                "layer": site.layer,
                "iteration": site.iteration,
                "metric": METRICS[self.task],
                "score": fitted.metric[row],
                "ci_low": low,
                "ci_high": high,
                "chance": fitted.chance[row],
                "p": p[row],
                "p_fwe": p_fwe[row],
                "recentred": moved.metric[row],
                "recentred_chance": moved.chance[row],
                "recentred_p_fwe": moved_p[row],
                "refitted": float(curve.refitted[row].mean()),
                "refitted_ci_low": low_refitted,
                "refitted_ci_high": high_refitted,
                "penalty": float(fitted.penalties[row, 0]),
                "n": self.labels.size,
                "groups": np.unique(self.groups).size,
            }


# -- the transfer --------------------------------------------------------------------------------------------

_DIGITS = 12
"""Number of a suite hash's digits in its identity."""


def transfer_probes(
    run: RunReader,
    other: RunReader,
    target: Target | str,
    other_target: Target | str | None = None,
    categories: Sequence[str] | None = None,
    views: Sequence[str] = ("mean",),
    *,
    window: int | None = None,
    permutations: int = 200,
    token_permutations: int = TOKEN_PERMUTATIONS,
    call: int = 0,
    seed: int = 0,
    across_weights: bool = False,
    progress: Progress | None = None,
) -> TransferResults:
    """Fit every site's probe on all of `run`, and score it on `other`; nothing is stored.

    C or λ is chosen by five folds of the groups of `run`; no label of `other` takes part in a fit. Groups of
    `other` that `run` has too are left out, see `shared_groups`. The null permutes the labels of `other`. There
    are two further scores. One is of the same probe after the features of `other` are moved to the mean of `run`.
    The other is the cross-validated score of `other` itself on the same samples. Raises as `train_probes` too.

    Args:
        run: Run on which the probes are fitted.
        other: Run on which they are scored.
        target: Label of `run`: a side, a built-in column or a `Target`.
        other_target: Label of `other`, of the same `Target.definition`; by default the same side or built-in
            column.
        categories: Categories that are pooled, by default all.
        views: Views of the tokens, as in `train_probes`, for both runs.
        window: Inferences per episode, as in `train_probes`; `other` takes the number that `run` has.
        permutations: Number of label permutations behind the p-values.
        token_permutations: Number of label permutations of token views.
        call: Captured inference, counted from 0, that a label of whole episodes is decoded from, for both runs.
        seed: Seed of folds and permutations, for both runs.
        across_weights: Allow two networks; sites and widths must still be equal.
        progress: Called after every site; by default a bar in a notebook, nothing elsewhere.

    Raises:
        SettingsMismatchError: For other weights, sites or definitions.
        TooFewGroupsError: If too few groups of `other` are not shared.
    """
    check_options(views, permutations, token_permutations)
    options: dict[str, Any] = {"views": views, "seed": seed, "call": call}
    pooled = categories or (EVERYWHERE,)
    of_other = target if other_target is None else other_target
    for reader in (run, other):
        check_run(reader, categories)
    side = ProbeSweep.of(run, target, pooled, window=window, permutations=0, **options)
    run_window = side.samples.window if side.target.per_step else None
    options |= {"permutations": permutations, "token_permutations": token_permutations, "window": run_window}
    other_side = ProbeSweep.of(other, of_other, pooled, **options)
    _check_alike(run, other, views, across_weights)
    train = make_problem(run, side.target, side.samples, EVERYWHERE, side.settings)
    if side.target.definition != other_side.target.definition:
        raise SettingsMismatchError(
            f"the label of {run.location} is {side.target.described}, that of {other.location} is "
            f"{other_side.target.described}; expected one definition. Give both the same column and task"
        )
    samples, shared = _unshared_samples(run, train.samples, other, other_side.samples, side.target.group_by)
    test = make_problem(other, other_side.target, samples, EVERYWHERE, other_side.settings)
    code = _codes(train.classes, test.classes)
    keys = [(view, site) for view in views for site in sites_of(other, view)]
    progress = progress or notebook_progress("sites")
    transferred: dict[tuple[str, Site], _Transferred] = {}
    for view, site in keys:
        run_samples, other_samples = (
            read_samples(source, view, site, rows.rows, rows.inferences)
            for source, rows in ((run, train.samples), (other, samples))
        )
        transferred[view, site] = _transfer(train, run_samples, test, other_samples, code)
        if progress is not None:
            progress(len(transferred), len(keys), f"{site} {view}")
    return TransferResults(
        model=run.label,
        other_model=other.label,
        same_weights=_same_weights(run, other),
        target=side.target.name,
        task=side.target.task,
        definition=side.target.definition,
        classes=test.classes,
        labels=samples.values,
        episodes=test.episodes,
        inferences=samples.inferences.astype(np.int64),
        groups=samples.groups,
        curves={view: _curve(other, test, view, transferred) for view in views},
        smallest_p=smallest_p_of_labels(test.labels, test.permuted_labels),
        trained_on={"samples": train.samples.rows.size, "groups": np.unique(train.samples.groups).size},
        left_out={**samples.left_out, **({"groups that both runs have": shared} if shared else {})},
    )


def shared_groups(
    run: RunReader, samples: TargetSamples, other: RunReader, other_samples: TargetSamples, group_by: str | None
) -> NDArray[np.str_]:
    """Return the names of the groups of `other_samples` that `samples` has too.

    Groups are compared by name where names mean the same. This is so with `group_by`, or if both runs are of one
    suite, data set or environment, or of selections of one suite. A group is also shared if it has an item whose
    id and content are in both.
    """
    names = np.unique(other_samples.groups)
    in_both = np.zeros(names.size, bool)
    if group_by is not None:
        _check_spelled_alike(run, np.unique(samples.groups).tolist(), other, names.tolist(), group_by)
    if group_by is not None or _sources(run) & _sources(other):
        in_both |= np.isin(names, samples.groups)
    contents, other_contents = _contents(run, samples), _contents(other, other_samples)
    both = set(contents.values()) & set(other_contents.values())
    group_of = dict(zip(other_samples.rows.tolist(), other_samples.groups.tolist(), strict=True))
    in_both |= np.isin(names, [group_of[row] for row, content in other_contents.items() if content in both])
    shared: NDArray[np.str_] = names[in_both]
    return shared


def _check_spelled_alike(
    run: RunReader, groups: Sequence[str], other: RunReader, other_groups: Sequence[str], group_by: str
) -> None:
    """Raise UsageError for a group of two runs in two spellings, which would be in both and not be left out."""
    of_likeness = {alike(name): name for name in groups}
    for name in other_groups:
        if (spelled := of_likeness.get(alike(name), name)) != name:
            raise UsageError(
                f"--group-by {group_by}: {other.location} has the group {name!r}, and {run.location} {spelled!r}; "
                "expected one spelling of one name. Write both alike, or other names if they differ"
            )


def _sources(run: RunReader) -> set[str]:
    """Return the names under which the source of a run is known."""
    digest = run.suite.partition("#")[2]
    parent = run.suite_parent
    return {name for name in (run.suite, digest[:_DIGITS], (parent or "")[:_DIGITS]) if name}


def _contents(run: RunReader, samples: TargetSamples) -> dict[int, tuple[str, str]]:
    """Return item id and content hash by row of the episodes; empty where the run has no items."""
    items = run.items
    if items is None or "item_id" not in run.episodes or "content_sha256" not in items:
        return {}
    content = dict(zip(items["item_id"].astype(str), items["content_sha256"], strict=True))
    ids = run.episodes["item_id"].astype(str).to_numpy()
    return {
        int(row): (ids[row], str(content[ids[row]])) for row in np.unique(samples.rows) if content.get(ids[row])
    }


def _check_alike(run: RunReader, other: RunReader, views: Sequence[str], across_weights: bool) -> None:
    """Raise SettingsMismatchError for two networks, unless that is allowed, and for other sites or widths."""
    if not (across_weights or _same_weights(run, other)):
        ours, theirs = ((reader.weights_sha256 or "unknown")[:12] for reader in (run, other))
        raise SettingsMismatchError(
            f"{run.location} has the weights {ours}, {other.location} {theirs}; expected one network, because a "
            "direction means nothing in another. Accept that with --across-weights (across_weights=True)"
        )
    for view in views:
        sites, other_sites = (
            [(str(site), run_of.streams[site.stream].width) for site in sites_of(run_of, view)]
            for run_of in (run, other)
        )
        if sites != other_sites:
            site, width = next(iter(set(sites) ^ set(other_sites)))
            raise SettingsMismatchError(
                f"view {view!r}: {run.location} has {len(sites)} sites, {other.location} {len(other_sites)}, and "
                f"not both have {site} of width {width}; expected the same sites and widths"
            )


def _same_weights(run: RunReader, other: RunReader) -> bool:
    """Whether both are known to be of one network."""
    return run.weights_sha256 is not None and run.weights_sha256 == other.weights_sha256


def _unshared_samples(
    run: RunReader, samples: TargetSamples, other: RunReader, other_samples: TargetSamples, group_by: str | None
) -> tuple[TargetSamples, int]:
    """Return the samples in groups that `run` does not have, and how many groups are left out.

    Raises:
        TooFewGroupsError: If fewer than five groups are left.
    """
    shared = shared_groups(run, samples, other, other_samples, group_by)
    unshared = ~np.isin(other_samples.groups, shared)
    remaining = np.unique(other_samples.groups[unshared]).size
    if remaining < OUTER_FOLDS:
        raise TooFewGroupsError(
            f"{shared.size} of the {np.unique(other_samples.groups).size} groups of {other.location} are in "
            f"{run.location} too, which leaves {remaining}; expected at least {OUTER_FOLDS} to score "
            "on. Give a run of other items or episodes. A study's [drift] compares probes on the same items"
        )
    return other_samples.of(unshared), int(shared.size)


def _codes(classes: Sequence[str], other_classes: Sequence[str]) -> Matrix | None:
    """Return the code in the other run of every class, (K,); -1 where it has none, None for quantities.

    Raises:
        UsageError: If the other run has a class that no probe was fitted to.
    """
    if not classes:
        return None
    if unknown := [name for name in other_classes if name not in classes]:
        raise UsageError(
            f"the other run has the class {unknown[0]!r}, which no probe was fitted to; expected some of "
            f"{', '.join(classes)}. Leave its cells empty, or fit on a run that has it"
        )
    return np.array([other_classes.index(name) if name in other_classes else -1 for name in classes], np.float64)


_Transferred = tuple[tuple[SiteProbe, SiteProbe], Matrix]
"""The probe of one site as fitted and recentred, scored on the other run; and scores of the other's own."""


def _transfer(
    train: Problem, run_samples: Samples, test: Problem, other_samples: Samples, code: Matrix | None
) -> _Transferred:
    count, other_count = run_samples.counts.size, other_samples.counts.size
    samples = Samples.joined([run_samples, other_samples, _recentre(other_samples, run_samples)])
    fold = NestedFold(
        Fold(np.arange(count), np.arange(count, count + 2 * other_count)), [fold.outer for fold in train.folds]
    )
    blank = np.zeros(count + 2 * other_count)  # in place of the other run's labels, which no fit may see
    blank[:count] = train.labels
    predicted, strength = predict_once(samples, blank, train.task, fold)
    if code is not None:
        predicted = code[predicted.astype(np.intp)]
    truth = np.column_stack([test.labels, test.permuted_for(other_samples)]).astype(np.float64)
    fitted, recentred = (
        _score_predictions(predictions, truth, test.task, strength)
        for predictions in np.split(predicted, [other_count])
    )
    return (fitted, recentred), probe_site(other_samples, truth[:, 0], truth[:, 1:1], test.folds, test.task).scores


def _recentre(samples_to_move: Samples, run_samples: Samples) -> Samples:
    """Return the samples of the other run, moved to the mean of the first run's."""
    means, run_means = (np.asarray(samples.means) for samples in (samples_to_move, run_samples))
    origin, goal = (values.mean(axis=0, dtype=np.float64) for values in (means, run_means))
    features = samples_to_move.read()
    moved = move_features(features, origin, goal).astype(features.dtype)
    if samples_to_move.pools:
        return Samples.pooled(moved)
    return Samples(RowSubset.all(moved), samples_to_move.counts, move_features(means, origin, goal))


def move_features(
    features: NDArray[Any], origin: Matrix, goal: Matrix, scale: Matrix | None = None
) -> NDArray[Any]:
    """Return features (E, D) of a run, recentred: moved from one mean (D,) to another, without labels.

    Args:
        features: Features to move.
        origin: Mean of the run they are of.
        goal: Mean of the run that the probe was fitted on.
        scale: Multiple (D,) of the deviations from the mean; None leaves them as they are.
    """
    if scale is None:
        return features + (goal - origin)
    return features * scale + (goal - origin * scale)


def _score_predictions(predicted: Matrix, truth: Matrix, task: Task, strength: float) -> SiteProbe:
    """Return the probe with (m,) predictions for the other run, from (m, 1 + P) real and permuted labels.

    R² compares with the mean of the other run's labels, as scikit-learn's `r2_score` does.
    """
    if task == "continuous":
        scores = 1 - (truth - predicted[:, None]) ** 2 / truth.var(axis=0)
    else:
        scores = balanced_scores(np.repeat(predicted[:, None], truth.shape[1], axis=1), truth)
    return SiteProbe(
        decisions=predicted,
        scores=scores[:, 0],
        strengths=np.array([strength]),
        weights=np.zeros((1, 0), np.float32),
        intercepts=np.zeros(1),
        spreads=np.zeros(1),
        null=scores.mean(axis=0)[1:],
        inner=np.zeros((0, predicted.size)),  # no fold of the other run chose anything
    )


def _curve(
    run: RunReader, test: Problem, view: str, transferred: dict[tuple[str, Site], _Transferred]
) -> TransferCurve:
    of_view = {site: result for (name, site), result in transferred.items() if name == view}
    parts = tuple(str(run.streams[site.stream].part) for site in of_view)
    # Balanced between classes, of a side too: no fold of the other run says which share of sides was trained on.
    balanced = replace(test, balanced=False)
    fitted, recentred = (
        balanced.curve({site: probes[at] for site, (probes, _) in of_view.items()}, parts) for at in (0, 1)
    )
    return TransferCurve(fitted, recentred, np.stack([refitted for _, refitted in of_view.values()]))


# -- table and sentences -------------------------------------------------------------------------------------

_LEGEND = (
    "Fitted on one run, scored on the other. The score of a chosen site is too high. Chance: mean score with "
    "labels of the other run exchanged. Recentred: features of the other run moved to the mean of the first. "
    "Refitted: cross-validated probe of the other run itself"
)


def transfer_table(results: TransferResults, splits: bool = True) -> Table:
    """Return a table with a row per stream and view, for its best site."""
    several, metric = len(results.curves) > 1, METRICS[results.task]
    rows = [
        (
            " · ".join([label_of(row["stream"]), *([row["view"]] if several else [])]),
            str(row["site"]),
            Cell(row["score"], three_digits, (row["ci_low"], row["ci_high"])),
            Cell(row["chance"], three_digits),
            Cell(row["p_fwe"], p_text),
            Cell(row["recentred"], three_digits),
            Cell(row["refitted"], three_digits, (row["refitted_ci_low"], row["refitted_ci_high"])),
        )
        for row in _best(results)
    ]
    title = [f"{results.target}: {metric}", f"{results.model} to {results.other_model}"]
    if not results.same_weights:
        title.append("OTHER WEIGHTS")
    headings = (
        "stream",
        "best site",
        f"{metric} [95 %]",
        "chance",
        "family-wise p",
        "recentred",
        "refitted [95 %]",
    )
    overflow = "split" if splits else "leave out"
    return Table.of(", ".join(title), headings, rows, notes=[_LEGEND], overflow=overflow)


def transfer_sentences(results: TransferResults) -> list[str]:
    """Return a sentence per reason for leaving samples out, then one per view: where the label transfers."""
    sentences = [f"left out: {count} {reason}" for reason, count in results.left_out.items()]
    groups, samples = results.trained_on["groups"], results.trained_on["samples"]
    on = f"fitted on {plural(groups, 'group')}, {plural(samples, 'sample')}"
    for view in results.curves:
        rows = [row for row in _best(results) if row["view"] == view]
        of = f"{on}; scored on {plural(rows[0]['groups'], 'group')}, {plural(rows[0]['n'], 'sample')}"
        of += f", view {view}" if len(results.curves) > 1 else ""
        sentences.append(f"{results.target} ({of}) {'; '.join(map(_verdict, rows))}.")
    return sentences


def _best(results: TransferResults) -> "list[pd.Series]":
    """Return the row of `scores` of the best site of every view and stream: the largest excess over chance."""
    return best_sites(results.scores.assign(category=EVERYWHERE))


def _verdict(row: "pd.Series") -> str:
    where, numbers = (
        f"in the {label_of(row['stream'])}",
        f"({row['metric']} {row['score']:.2f}, refitted {row['refitted']:.2f})",
    )
    if row["p_fwe"] != row["p_fwe"]:
        return f"was not tested {where} {numbers}"
    if row["p_fwe"] < SIGNIFICANCE:
        return f"transfers {where} at {row['site']} {numbers}"
    return f"is not shown to transfer {where} {numbers}"
