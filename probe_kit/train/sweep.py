"""Probe every site of a run: `train_probes`."""

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import (
    NonFiniteActivationError,
    NoProbesError,
    TooFewGroupsError,
    UnknownCategoryError,
    UnknownSiteError,
)
from probe_kit.hooks.sites import Site
from probe_kit.identity import derive_seed
from probe_kit.train.permutation import exchange_items, flip_items
from probe_kit.train.probe import NestedFold, SiteProbe, nested_folds, probe_site
from probe_kit.train.reader import RunReader
from probe_kit.train.results import Curve, ProbeResults, ProbeSettings, episodes_sha256, load_results
from probe_kit.train.targets import Target, target_labels

if TYPE_CHECKING:
    import pandas as pd

Progress = Callable[[int, int, str], None]
"""Called with (sites done, sites in all, what was just done)."""


@dataclass(frozen=True)
class CategoryProblem:
    """What all sites of a category share: which episodes, their labels, folds and relabellings.

    rows: (E,) positions in the run's episode table. labels: (E,). relabellings: (E, P).
    """

    rows: NDArray[np.intp]
    labels: NDArray[np.bool_]
    items: NDArray[np.str_]
    groups: NDArray[np.str_]
    episodes: NDArray[np.str_]
    folds: list[NestedFold]
    relabellings: NDArray[np.bool_]


def train_probes(
    run: RunReader,
    categories: Sequence[str] | None = None,
    views: Sequence[str] = ("mean",),
    *,
    permutations: int = 200,
    target: Target = "correct",
    seed: int = 0,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> ProbeResults:
    """Probe every site of every stream for `target`, per category and view, and store the results in the run.

    categories: all by default. permutations: relabellings behind the p-values. jobs: sites probed at a time,
    one per core by default. The same settings on the same episodes are read back instead of fitted again; an
    interrupted sweep continues after the last finished site.
    Raises NoProbesError for a run without activations, UnknownCategoryError, UnknownSiteError for a view no
    stream has, TooFewGroupsError, ProbeNotConvergedError.
    """
    settings = _settings(run, categories, views, target, permutations, seed)
    home = run.path / "probes"
    if (home / settings.key).exists():
        return load_results(run, settings.key)
    problems = {category: category_problem(run.episodes, category, settings) for category in settings.categories}
    work = [(view, site) for view in settings.views for site in _sites(run, view)]
    partial = home / f".{settings.key}.partial"
    probes = _probe_all(run, problems, work, partial, jobs, progress)
    curves = {
        (category, view): _curve(problems[category], category, view, probes)
        for category in settings.categories
        for view in settings.views
    }
    results = ProbeResults(settings, curves, {name: stream.layers for name, stream in run.streams.items()})
    results.save(run.path)
    shutil.rmtree(partial, ignore_errors=True)
    return results


def category_problem(episodes: "pd.DataFrame", category: str, settings: ProbeSettings) -> CategoryProblem:
    """The probing problem of one category. Raises TooFewGroupsError."""
    defined = target_labels(episodes, settings.target, settings.seed)
    rows = np.flatnonzero((episodes["category"] == category).to_numpy() & (defined >= 0))
    table, labels = episodes.iloc[rows], defined[rows] == 1
    groups = table["group_id"].to_numpy(dtype=str)
    try:
        folds = nested_folds(labels, groups, derive_seed("folds", settings.seed, category))
    except TooFewGroupsError as error:
        raise TooFewGroupsError(f"category {category!r}, target {settings.target!r}: {error}") from error
    return CategoryProblem(
        rows=rows,
        labels=labels,
        items=table["item_id"].to_numpy(dtype=str),
        groups=groups,
        episodes=table["episode_id"].to_numpy(dtype=str),
        folds=folds,
        relabellings=_relabel(table, labels, category, settings, folds),
    )


def _relabel(
    table: "pd.DataFrame",
    labels: NDArray[np.bool_],
    category: str,
    settings: ProbeSettings,
    folds: list[NestedFold],
) -> NDArray[np.bool_]:
    """(E, P) relabellings, without those that leave a training fold with a single class: they have no probe."""
    seed, count = derive_seed("relabelling", settings.seed, category), settings.permutations
    if settings.target == "chosen":
        drawn = exchange_items(labels, table["item_id"], table["layout"], count, seed)
    else:
        drawn = flip_items(labels, table["item_id"], count, seed)
    shares = np.array([drawn[inner.train].mean(axis=0) for fold in folds for inner in fold.inner])
    return drawn[:, ((shares > 0) & (shares < 1)).all(axis=0)]


def _settings(
    run: RunReader,
    categories: Sequence[str] | None,
    views: Sequence[str],
    target: Target,
    permutations: int,
    seed: int,
) -> ProbeSettings:
    if not run.streams:
        raise NoProbesError(f"{run.path} has no activations to probe: policy {run.model!r} has no streams.")
    known = list(dict.fromkeys(run.episodes["category"]))
    for category in categories or ():
        if category not in known:
            raise UnknownCategoryError(f"{run.path} has no category {category!r}; it has: {', '.join(known)}")
    return ProbeSettings(
        model=run.model,
        random_weights=run.random_weights,
        suite=run.suite,
        run_settings=run.settings_sha256,
        episodes=episodes_sha256(run),
        categories=tuple(categories or known),
        views=tuple(views),
        target=target,
        permutations=permutations,
        seed=seed,
    )


def _sites(run: RunReader, view: str) -> list[Site]:
    """Sites that have `view`, over all streams."""
    sites = [site for stream in run.streams if view in run.views(stream) for site in run.sites(stream)]
    if not sites:
        known = sorted({name for stream in run.streams for name in run.views(stream)})
        raise UnknownSiteError(f"{run.path} has no view {view!r}; it has: {', '.join(known)}")
    return sites


def _curve(
    problem: CategoryProblem,
    category: str,
    view: str,
    probes: Mapping[tuple[str, Site], Mapping[str, SiteProbe]],
) -> Curve:
    found = {site: probe[category] for (name, site), probe in probes.items() if name == view}
    fold_of = np.empty(problem.labels.size, dtype=np.int64)
    for number, fold in enumerate(problem.folds):
        fold_of[fold.outer.test] = number
    return Curve(
        sites=tuple(found),
        labels=problem.labels,
        episodes=problem.episodes,
        items=problem.items,
        groups=problem.groups,
        fold_of=fold_of,
        decisions=np.stack([probe.decisions for probe in found.values()]),
        strengths=np.stack([probe.strengths for probe in found.values()]),
        null=np.stack([probe.null for probe in found.values()]),
    )


def _probe_all(
    run: RunReader,
    problems: Mapping[str, CategoryProblem],
    work: Sequence[tuple[str, Site]],
    partial: Path,
    jobs: int | None,
    progress: Progress | None,
) -> dict[tuple[str, Site], dict[str, SiteProbe]]:
    """Every (view, site) of `work` for every category, in the order of `work`.

    Threads suffice: the time goes into matrix products, which let other threads run.
    """
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    workers = min(jobs or os.cpu_count() or 1, len(work))
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(workers) as pool:
        tasks = {pool.submit(_probe_one, run, problems, view, site, partial): (view, site) for view, site in work}
        try:
            for done, task in enumerate(as_completed(tasks), start=1):
                task.result()
                if progress is not None:
                    view, site = tasks[task]
                    progress(done, len(work), f"{site} {view}")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return {pair: task.result() for task, pair in tasks.items()}


def _probe_one(
    run: RunReader, problems: Mapping[str, CategoryProblem], view: str, site: Site, partial: Path
) -> dict[str, SiteProbe]:
    """One site for all categories, read back from `partial` if a former sweep got that far."""
    file = partial / f"{view}+{site}.npz"
    if file.exists():
        return _read_partial(file)
    column = _finite_column(run, site, view)
    probes = {
        category: probe_site(column[problem.rows], problem.labels, problem.relabellings, problem.folds)
        for category, problem in problems.items()
    }
    partial.mkdir(parents=True, exist_ok=True)
    draft = file.with_suffix(".draft.npz")
    np.savez(
        draft,
        **{
            f"{category}/{name}": value
            for category, probe in probes.items()
            for name, value in vars(probe).items()
        },
    )
    draft.replace(file)
    return probes


def _finite_column(run: RunReader, site: Site, view: str) -> NDArray[np.float32]:
    column = run.column(site, view)
    broken = np.flatnonzero(~np.isfinite(column).all(axis=1))
    if broken.size:
        raise NonFiniteActivationError(
            f"{site}, view {view!r}, of {run.path} holds NaN or infinity in {broken.size} of {len(column)} "
            f"episodes, the first {run.episodes['episode_id'].iloc[broken[0]]!r}; expected finite features. "
            "Extract these episodes again."
        )
    return column


def _read_partial(file: Path) -> dict[str, SiteProbe]:
    with np.load(file, allow_pickle=False) as arrays:
        categories = dict.fromkeys(name.rsplit("/", 1)[0] for name in arrays)
        return {
            category: SiteProbe(
                **{part: arrays[f"{category}/{part}"] for part in ("decisions", "strengths", "null")}
            )
            for category in categories
        }
