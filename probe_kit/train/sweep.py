"""Probe every site of a run: `train_probes`."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NonFiniteActivationError, NoProbesError, UnknownCategoryError, UnknownSiteError
from probe_kit.hooks.sites import Site
from probe_kit.train.curve import Curve
from probe_kit.train.problem import POOLED, CategoryProblem, category_problem
from probe_kit.train.reader import RunReader
from probe_kit.train.results import ProbeResults, ProbeSettings, episodes_sha256
from probe_kit.train.store import Unfinished, is_stored, load_results, save_results
from probe_kit.train.targets import Target
from probe_kit.train.workers import Key, Probed, probe_columns

Progress = Callable[[int, int, str], None]
"""Called with (sites done, sites in all, what was just done)."""


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

    categories: each one by default; `all` pools every episode of the run. permutations: relabellings behind the
    p-values. jobs: processes that probe, this one alone by default; with more than one, a script needs
    `if __name__ == "__main__":`. The same settings on the same episodes are read back instead of fitted again;
    an interrupted sweep continues after the last finished site.
    Raises NoProbesError for a run without activations, UnknownCategoryError, UnknownSiteError for a view no
    stream has, TooFewGroupsError, ProbeNotConvergedError.
    """
    settings = _settings(run, categories, views, target, permutations, seed)
    if is_stored(run.path, settings.key):
        return load_results(run, settings.key)
    problems = {category: category_problem(run.episodes, category, settings) for category in settings.categories}
    probes = _probe_all(run, problems, settings, jobs, progress)
    curves = {
        (category, view): _curve(problem, category, view, probes)
        for category, problem in problems.items()
        for view in settings.views
    }
    results = ProbeResults(settings, curves)
    save_results(results, run.path)
    Unfinished.of(run.path, settings.key).discard()
    return results


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
        if category not in (*known, POOLED):
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
    probes: Mapping[Key, Probed],
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
    settings: ProbeSettings,
    jobs: int | None,
    progress: Progress | None,
) -> dict[Key, Probed]:
    """Every view and site, in order, for every category; what a former sweep finished is read back."""
    keys = [(view, site) for view in settings.views for site in _sites(run, view)]
    unfinished = Unfinished.of(run.path, settings.key)
    probes = {key: stored for key in keys if (stored := unfinished.read(*key)) is not None}
    columns = ((key, _finite_column(run, *key)) for key in keys if key not in probes)
    for key, found in probe_columns(columns, problems, jobs or 1):
        unfinished.keep(*key, found)
        probes[key] = found
        if progress is not None:
            progress(len(probes), len(keys), f"{key[1]} {key[0]}")
    return {key: probes[key] for key in keys}


def _finite_column(run: RunReader, view: str, site: Site) -> NDArray[np.float32]:
    column = run.column(site, view)
    broken = np.flatnonzero(~np.isfinite(column).all(axis=1))
    if broken.size:
        raise NonFiniteActivationError(
            f"{site}, view {view!r}, of {run.path} holds NaN or infinity in {broken.size} of {len(column)} "
            f"episodes, the first {run.episodes['episode_id'].iloc[broken[0]]!r}; expected finite features. "
            "Extract these episodes again."
        )
    return column
