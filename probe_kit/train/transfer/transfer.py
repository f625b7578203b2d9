"""Probes fitted on all of one run and scored on another: `transfer_probes`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._terminal.notebook import notebook_progress
from probe_kit.errors import SettingsMismatchError, TooFewGroupsError, UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.statistics.folds import OUTER_FOLDS, Fold
from probe_kit.train.crossval.nested_folds import NestedFold
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.data.samples import sites_of
from probe_kit.train.labels.label_probe import predict_once
from probe_kit.train.labels.label_problem import LabelProblem, label_problem
from probe_kit.train.labels.label_results import LabelCurve
from probe_kit.train.labels.label_sweep import check_label_run
from probe_kit.train.labels.labelled_samples import LabelledSamples, labelled_samples
from probe_kit.train.labels.labels import Labels
from probe_kit.train.labels.task_scores import balanced_scores
from probe_kit.train.transfer.transfer_results import TransferCurve, TransferResults

Progress = Callable[[int, int, str], None]
Matrix = NDArray[np.float64]
_DIGITS = 12
"""Of a suite's hash, in its identity."""


def transfer_probes(
    run: RunReader,
    other: RunReader,
    labels: Labels,
    other_labels: Labels,
    categories: Sequence[str] | None = None,
    views: Sequence[str] = ("mean",),
    *,
    window: int | None = None,
    permutations: int = 200,
    call: int = 0,
    seed: int = 0,
    across_weights: bool = False,
    progress: Progress | None = None,
) -> TransferResults:
    """Fit every site's probe on all of `run`, and score it on `other`; nothing is stored.

    λ or C is chosen by five folds of the groups of `run`; no label of `other` takes part in a fit. Groups of
    `other` that `run` has too are left out, see `shared_groups`. The null exchanges labels between groups of
    `other`. Besides: the same probe after the features of `other` are moved to the mean of `run`, and the
    cross-validated score of `other` itself on the same samples.
    labels, other_labels: of either run, of one `Labels.definition`. across_weights: allow two networks; sites and
    widths must still be equal. Others: as in `train_label_probes`, for both runs.
    Raises SettingsMismatchError for other weights, sites or label definitions, TooFewGroupsError where too few
    groups are not shared, and what `train_label_probes` raises.
    """
    for one in (run, other):
        check_label_run(one, categories, views, permutations)
    _check_alike(run, other, views, across_weights)
    train = _fitted_side(run, labels, categories, call, window, seed)
    if labels.definition != other_labels.definition:
        raise SettingsMismatchError(
            f"the label of {run.location} is {labels.described}, that of {other.location} is "
            f"{other_labels.described}; expected one definition. Give both the same column and task"
        )
    own_window = train.samples.window if labels.per_step else None
    samples = labelled_samples(other, other_labels, categories, call, own_window)
    other_labels, _ = other_labels.on(other)
    samples, shared = _unshared(run, train.samples, other, samples, labels.group_by)
    test = label_problem(other, other_labels, samples, permutations, seed)
    code = _codes(train.classes, test.classes)
    keys = [(view, site) for view in views for site in sites_of(other, view)]
    progress = progress or notebook_progress("sites")
    found: dict[tuple[str, Site], _Transferred] = {}
    for view, site in keys:
        here, there = train.samples.features(run, view, site), samples.features(other, view, site)
        found[view, site] = _transfer(train, here, test, there, code)
        if progress is not None:
            progress(len(found), len(keys), f"{site} {view}")
    return TransferResults(
        model=run.label,
        other_model=other.label,
        same_weights=_same_weights(run, other),
        target=labels.target,
        task=labels.task,
        definition=labels.definition,
        classes=test.classes,
        labels=samples.values,
        episodes=other.episodes["episode_id"].to_numpy(dtype=str)[samples.rows],
        inferences=samples.inferences.astype(np.int64),
        groups=samples.groups,
        curves={view: _curve(other, [site for own, site in keys if own == view], view, found) for view in views},
        smallest_p=test.smallest_p,
        trained_on={"samples": train.samples.rows.size, "groups": np.unique(train.samples.groups).size},
        left_out={**samples.left_out, **({"groups that both runs have": shared} if shared else {})},
    )


def shared_groups(
    run: RunReader, samples: LabelledSamples, other: RunReader, others: LabelledSamples, group_by: str | None
) -> NDArray[np.str_]:
    """Names of the groups of `others` that `samples` has too.

    By name, where names mean the same: with `group_by`, or if both runs are of one suite, data set or environment,
    or of selections of one suite. Also those with an item whose id and content are in both.
    """
    names = np.unique(others.groups)
    found = np.zeros(names.size, bool)
    if group_by is not None or _sources(run) & _sources(other):
        found |= np.isin(names, samples.groups)
    here, there = _contents(run, samples), _contents(other, others)
    both = set(here.values()) & set(there.values())
    group_of = dict(zip(others.rows.tolist(), others.groups.tolist(), strict=True))
    found |= np.isin(names, [group_of[row] for row, content in there.items() if content in both])
    shared: NDArray[np.str_] = names[found]
    return shared


def _sources(run: RunReader) -> set[str]:
    """Names under which what a run shows is known."""
    digest = run.suite.partition("#")[2]
    parent = getattr(run, "suite_parent", None)
    return {name for name in (run.suite, digest[:_DIGITS], (parent or "")[:_DIGITS]) if name}


def _contents(run: RunReader, samples: LabelledSamples) -> dict[int, tuple[str, str]]:
    """Item id and content hash by row of the episodes; empty where the run has no items."""
    items = getattr(run, "items", None)
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
        ours, theirs = ((one.weights_sha256 or "unknown")[:12] for one in (run, other))
        raise SettingsMismatchError(
            f"{run.location} has the weights {ours}, {other.location} {theirs}; expected one network, because a "
            "direction means nothing in another. Accept that with --across-weights (across_weights=True)"
        )
    for view in views:
        here, there = (
            [(str(site), run_of.streams[site.stream].width) for site in sites_of(run_of, view)]
            for run_of in (run, other)
        )
        if here != there:
            site, width = next(iter(set(here) ^ set(there)))
            raise SettingsMismatchError(
                f"view {view!r}: {run.location} has {len(here)} sites, {other.location} {len(there)}, and not "
                f"both have {site} of width {width}; expected the same sites and widths"
            )


def _same_weights(run: RunReader, other: RunReader) -> bool:
    """Whether both are known to be of one network."""
    return run.weights_sha256 is not None and run.weights_sha256 == other.weights_sha256


def _fitted_side(
    run: RunReader, labels: Labels, categories: Sequence[str] | None, call: int, window: int | None, seed: int
) -> LabelProblem:
    samples = labelled_samples(run, labels, categories, call, window)
    labels, _ = labels.on(run)
    return label_problem(run, labels, samples, 0, seed)


def _unshared(
    run: RunReader, here: LabelledSamples, other: RunReader, there: LabelledSamples, group_by: str | None
) -> tuple[LabelledSamples, int]:
    """The samples in groups that `run` does not have, and how many groups are left out."""
    shared = shared_groups(run, here, other, there, group_by)
    kept = ~np.isin(there.groups, shared)
    left = np.unique(there.groups[kept]).size
    if left < OUTER_FOLDS:
        raise TooFewGroupsError(
            f"{shared.size} of the {np.unique(there.groups).size} groups of {other.location} are in "
            f"{run.location} too, which leaves {left}; expected at least {OUTER_FOLDS} to score "
            "on. Give a run of other items or episodes"
        )
    return there.of(kept), int(shared.size)


def _codes(classes: Sequence[str], others: Sequence[str]) -> Matrix | None:
    """(K,) code in the other run of every class; -1 where it has none, None for quantities."""
    if not classes:
        return None
    if unknown := [name for name in others if name not in classes]:
        raise UsageError(
            f"the other run has the class {unknown[0]!r}, which no probe was fitted to; expected some of "
            f"{', '.join(classes)}. Leave its cells empty, or fit on a run that has it"
        )
    return np.array([others.index(name) if name in others else -1 for name in classes], np.float64)


@dataclass(frozen=True)
class _Transferred:
    """Of one site. plain, moved: (m,) predictions as fitted, and on recentred features. own: (m,) scores."""

    plain: Matrix
    moved: Matrix
    scores: tuple[Matrix, Matrix]
    null: tuple[Matrix, Matrix]
    own: Matrix
    penalty: float


def _transfer(
    train: LabelProblem, here: NDArray[Any], test: LabelProblem, there: NDArray[Any], code: Matrix | None
) -> _Transferred:
    shift = here.mean(axis=0, dtype=np.float64) - there.mean(axis=0, dtype=np.float64)
    features = np.concatenate([here, there, (there + shift).astype(here.dtype)])
    fold = NestedFold(
        Fold(np.arange(len(here)), np.arange(len(here), len(features))), [fold.outer for fold in train.folds]
    )
    blank = np.zeros(len(features))  # in place of the other run's labels, which no fit may see
    blank[: len(here)] = train.samples.values
    predicted, penalty = predict_once(features, blank, train.task, fold)
    if code is not None:
        predicted = code[predicted.astype(np.intp)]
    plain, moved = predicted[: len(there)], predicted[len(there) :]
    of_plain, of_moved = (_scores(one, test) for one in (plain, moved))
    own = test.score(there).scores
    return _Transferred(plain, moved, (of_plain[0], of_moved[0]), (of_plain[1], of_moved[1]), own, penalty)


def _scores(predicted: Matrix, test: LabelProblem) -> tuple[Matrix, Matrix]:
    """(m,) scores of the real labels, and (P,) the metric of every exchange.

    R² compares with the mean of the other run's labels, as scikit-learn's `r2_score` does.
    """
    truth = test.columns
    if test.task == "continuous":
        scores = 1 - (truth - predicted[:, None]) ** 2 / truth.var(axis=0)
    else:
        scores = balanced_scores(np.repeat(predicted[:, None], truth.shape[1], axis=1), truth)
    return scores[:, 0], scores.mean(axis=0)[1:]


def _curve(
    run: RunReader, sites: Sequence[Site], view: str, found: dict[tuple[str, Site], _Transferred]
) -> TransferCurve:
    own = [found[view, site] for site in sites]
    parts = tuple(str(run.streams[site.stream].part) for site in sites)
    penalties = np.array([[one.penalty] for one in own])
    plain, moved = (
        LabelCurve(
            tuple(sites),
            parts,
            np.stack([(one.plain, one.moved)[at] for one in own]),
            np.stack([one.scores[at] for one in own]),
            np.stack([one.null[at] for one in own]),
            penalties,
            np.zeros((len(own), 0, 0), np.float32),
        )
        for at in (0, 1)
    )
    return TransferCurve(plain, moved, np.stack([one.own for one in own]))
