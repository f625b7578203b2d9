"""Probes of every site of a run: `train_probes`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast, overload

import numpy as np

from probe_kit._terminal.notebook import notebook_progress
from probe_kit.errors import NoProbesError, RunIncompleteError, UnknownCategoryError, UsageError
from probe_kit.runs.scene_only import check_scene_run
from probe_kit.statistics.folds import FoldUnit, sums_by_group
from probe_kit.train.choices import Baseline, Incomplete, LabelControl, Target
from probe_kit.train.controls.fit_controls import add_baselines, add_untrained, check_untrained, prepare_baselines
from probe_kit.train.crossval.category_problem import POOLED, CategoryProblem, category_problem
from probe_kit.train.data.captured_call import restrict_to_call
from probe_kit.train.data.run_reader import RunReader, seed_text_of
from probe_kit.train.data.samples import is_token_view, read_samples, sites_of
from probe_kit.train.execution import ExecutionSettings, Key, Probed, probe_columns
from probe_kit.train.labels.label_results import LabelResults
from probe_kit.train.labels.label_sweep import train_label_probes
from probe_kit.train.labels.labels import Labels
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_directions import Direction
from probe_kit.train.results.probe_results import ProbeResults, episodes_sha256
from probe_kit.train.results.resume import SweepCheckpoint
from probe_kit.train.results.store import is_stored, load_results, save_results, stamp_of_run
from probe_kit.train.settings import ProbeSettings
from probe_kit.train.solver.backend import check_device

TOKEN_PERMUTATIONS = 59
"""Label permutations of token views by default."""
Progress = Callable[[int, int, str], None]
"""Called with (sites done, sites in all, what was just done)."""


@overload
def train_probes(
    run: RunReader,
    categories: Sequence[str] | None = None,
    views: Sequence[str] = ("mean",),
    *,
    labels: Labels,
    window: int | None = None,
    permutations: int = 200,
    call: int = 0,
    controls: Sequence[LabelControl] | None = None,
    suite: Path | None = None,
    untrained: RunReader | None = None,
    align_to: Labels | None = None,
    seed: int = 0,
    jobs: int | None = None,
    ray: str | None = None,
    progress: Progress | None = None,
) -> LabelResults: ...


@overload
def train_probes(
    run: RunReader,
    categories: Sequence[str] | None = None,
    views: Sequence[str] = ("mean",),
    *,
    permutations: int = 200,
    token_permutations: int = TOKEN_PERMUTATIONS,
    target: Target = "correct",
    labels: None = None,
    call: int = 0,
    folds: FoldUnit = "groups",
    incomplete: Incomplete = "keep",
    controls: Sequence[Baseline] | None = None,
    suite: Path | None = None,
    untrained: RunReader | None = None,
    seed: int = 0,
    jobs: int | None = None,
    device: str | None = None,
    ray: str | None = None,
    progress: Progress | None = None,
) -> ProbeResults: ...


def train_probes(
    run: RunReader,
    categories: Sequence[str] | None = None,
    views: Sequence[str] = ("mean",),
    *,
    permutations: int = 200,
    token_permutations: int = TOKEN_PERMUTATIONS,
    target: Target = "correct",
    labels: Labels | None = None,
    window: int | None = None,
    align_to: Labels | None = None,
    call: int = 0,
    folds: FoldUnit = "groups",
    incomplete: Incomplete = "keep",
    controls: Sequence[Baseline] | Sequence[LabelControl] | None = None,
    suite: Path | None = None,
    untrained: RunReader | None = None,
    seed: int = 0,
    jobs: int | None = None,
    device: str | None = None,
    ray: str | None = None,
    progress: Progress | None = None,
) -> ProbeResults | LabelResults:
    """Probe every site of every stream for `target`, per category and view, and store the results in the run.

    categories: each one by default; `all` pools every episode of the run. views: pooled ones, and `tokens` or
    `tokens:ROLE`, where every token is a sample and an episode's decision the mean of its tokens'. permutations:
    label permutations behind the p-values, of which token views, many times as dear, take the first
    `token_permutations`. call: which captured inference, counted from 0; episodes that ended before it are left
    out. folds: `concepts` also keeps items about the same two concepts together. incomplete: `drop` leaves out
    items of which an episode is missing. controls: baselines that never see the model, of `position`,
    `instruction`, and `pixels` and `random-features`, which need pictures; () for none. By default
    `random-features` and `pixels`; where the pictures cannot be found a warning says that they were left out.
    suite: folder of the run's suite; the embedded one is found or drawn again without it. untrained: a run of the
    same episodes, usually by random weights, to subtract. What is no better than `random-features` and the
    untrained network is no signal, whatever its p-value. jobs: processes that probe, this one alone by default;
    with more than one, a script needs `if __name__ == "__main__":`. device: where torch solves the probes, such as
    `cuda`; numpy without one. ray: address of a Ray cluster that probes, `auto` for the one this process belongs
    to or a new one on this machine; `jobs` is then how many sites at once, by default as many as it has cores.

    labels: a label of one's own, see `Labels`, instead of `target`. Its categories are probed together, as
    `window`, `align_to`, `controls`, `untrained` and pooled views of `train_label_probes` have it, and the results
    are a `LabelResults`. `target`, `folds`, `incomplete` and `device` are then left out.

    progress: by default a bar in a notebook, nothing elsewhere.

    With the same settings and episodes the stored results are returned, whatever jobs and device; an
    interrupted sweep continues after the last finished site; controls are added to what is stored. Nothing is
    stored before all of it is fitted: where this raises, `load_results` finds what it found before.
    Raises RunIncompleteError for a run without episodes, NoProbesError for one without activations,
    UnknownCategoryError, UnknownSiteError for a view no stream has, TooFewGroupsError, UnbalancedEpisodesError,
    ProbeNotConvergedError, UsageError, SuiteError for another suite, and SuiteNotFoundError for a control that was
    asked for and whose pictures cannot be found.
    """
    _check_options(views, permutations, token_permutations, jobs, device, ray)
    if labels is not None:
        _check_label_options(target, folds, incomplete, device)
        return train_label_probes(
            run,
            labels,
            categories,
            views,
            window=window,
            permutations=permutations,
            call=call,
            controls=controls,
            suite=suite,
            untrained=untrained,
            align_to=align_to,
            seed=seed,
            jobs=jobs,
            ray=ray,
            progress=progress,
        )
    if window is not None or align_to is not None:
        given = f"window={window}" if window is not None else "align_to"
        raise UsageError(f"{given} without labels; it needs labels of single inferences")
    check_scene_run(run, f"a probe of the side ({target})")
    crew = ExecutionSettings(jobs, device, ray)
    if len(run.episodes) == 0:
        raise RunIncompleteError(f"{run.location} has no finished episode to probe. Finish it first")
    categories = _categories(run, categories)
    run = restrict_to_call(run, call)
    asked = _settings(
        run, categories, views, target, folds, incomplete, permutations, token_permutations, seed, call
    )
    sweep = _Sweep.of(run, asked, crew, progress)
    prepared = prepare_baselines(run, cast("Sequence[Baseline] | None", controls), suite, sweep.stored)
    beside = None
    if untrained is not None:
        untrained = restrict_to_call(untrained, call)
        other = _settings(
            untrained,
            asked.categories,
            views,
            target,
            folds,
            incomplete,
            permutations,
            token_permutations,
            seed,
            call,
        )
        check_untrained(run, untrained, other)
        beside = _Sweep.of(untrained, other, crew, progress)
    results = add_baselines(sweep.results(), run, prepared)
    if beside is not None:
        others = beside.results()
        results = add_untrained(results, others)
        beside.keep(others, asked=False)
    return sweep.keep(results, asked=True)


def _check_options(
    views: Sequence[str],
    permutations: int,
    token_permutations: int,
    jobs: int | None,
    device: str | None,
    ray: str | None,
) -> None:
    """Raise UsageError for what can be seen to be wrong without looking at the run."""
    check_device(device)
    if device is not None and ((jobs or 1) > 1 or ray is not None):
        raise UsageError(
            f"device {device!r} is used by one process, got jobs={jobs}, ray={ray!r}. Leave `jobs` and `ray` out."
        )
    if jobs is not None and jobs < 1:
        raise UsageError(f"jobs={jobs}; expected at least 1 process, or None")
    if min(permutations, token_permutations) < 0:
        raise UsageError(
            f"permutations={permutations}, token_permutations={token_permutations}; expected 0 or more (0: no p)"
        )
    if not views or len(set(views)) < len(views):
        raise UsageError(f"views {', '.join(views) or 'none'}; expected one or more, each once, such as mean")


def _check_label_options(target: Target, folds: FoldUnit, incomplete: Incomplete, device: str | None) -> None:
    """Raise UsageError for options that probes of a label do not have."""
    given = {
        "target": target != "correct",
        "folds": folds != "groups",
        "incomplete": incomplete != "keep",
        "device": device is not None,
    }
    if wrong := [name for name, other in given.items() if other]:
        raise UsageError(f"{' and '.join(wrong)} with labels; expected neither. Leave out {' and '.join(wrong)}")


@dataclass(frozen=True)
class _Sweep:
    """What is to be probed in one run. stored: its results, if the same was probed before."""

    run: RunReader
    settings: ProbeSettings
    stored: ProbeResults | None
    problems: Mapping[str, CategoryProblem]
    keys: tuple[Key, ...]
    crew: ExecutionSettings
    progress: Progress | None

    @classmethod
    def of(
        cls, run: RunReader, settings: ProbeSettings, crew: ExecutionSettings, progress: Progress | None
    ) -> "_Sweep":
        """Nothing is probed yet, but what can be wrong is found."""
        if is_stored(run.location, settings.key):
            return cls(run, settings, load_results(run, settings.key), {}, (), crew, progress)
        problems = {name: category_problem(run.episodes, name, settings) for name in settings.categories}
        keys = tuple((view, site) for view in settings.views for site in sites_of(run, view))
        return cls(run, settings, None, problems, keys, crew, progress)

    def results(self) -> ProbeResults:
        """Those that are stored, or new ones that are not stored yet."""
        return _fit(self) if self.stored is None else self.stored

    def keep(self, results: ProbeResults, *, asked: bool) -> ProbeResults:
        """Store `results` and return them as loaded from the store."""
        save_results(results, self.run.location, asked=asked)
        SweepCheckpoint.of(self.run.location, self.settings.key).discard()
        return load_results(self.run, self.settings.key)


def _categories(run: RunReader, asked: Sequence[str] | None) -> Sequence[str]:
    """What was asked, or all of the run, whichever of its episodes got as far as the call that is probed."""
    known = list(dict.fromkeys(run.episodes["category"]))
    for category in asked or ():
        if category not in (*known, POOLED):
            raise UnknownCategoryError(f"{run.location} has no category {category!r}; it has: {', '.join(known)}")
    return asked or known


def probe_settings(
    run: RunReader, *, views: Sequence[str], permutations: int, target: Target, seed: int
) -> ProbeSettings:
    """The settings of the probes that `train_probes` fits with these options and all others at their default.

    Their key is that of the stored results. Nothing is fitted. Raises NoProbesError for a run without activations.
    """
    categories = _categories(run, None)
    return _settings(run, categories, views, target, "groups", "keep", permutations, TOKEN_PERMUTATIONS, seed, 0)


def _settings(
    run: RunReader,
    categories: Sequence[str],
    views: Sequence[str],
    target: Target,
    folds: FoldUnit,
    incomplete: Incomplete,
    permutations: int,
    token_permutations: int,
    seed: int,
    call: int,
) -> ProbeSettings:
    if not run.streams:
        raise NoProbesError(f"{run.location} has no activations to probe: of {run.model!r} no stream was stored.")
    return ProbeSettings(
        model=run.model,
        random_weights=run.random_weights,
        weights=run.weights_sha256,
        suite=run.suite,
        seed_text=seed_text_of(run),
        run_settings=run.settings_sha256,
        episodes=episodes_sha256(run),
        categories=tuple(categories),
        views=tuple(views),
        target=target,
        permutations=permutations,
        seed=seed,
        token_permutations=min(token_permutations, permutations) if any(map(is_token_view, views)) else 0,
        call=call,
        folds=folds,
        incomplete=incomplete,
    )


def _fit(sweep: _Sweep) -> ProbeResults:
    probes = _probe_all(sweep)
    curves = {
        (category, view): _curve(sweep.run, problem, category, view, probes)
        for category, problem in sweep.problems.items()
        for view in sweep.settings.views
    }
    directions = {
        (category, view, site): Direction(probe.weights, probe.intercepts, probe.spreads)
        for (view, site), found in probes.items()
        for category, probe in found.items()
    }
    stamp, label = stamp_of_run(sweep.run), sweep.run.label
    return ProbeResults(sweep.settings, curves, directions, stamp=stamp, label=label)


def _probe_all(sweep: _Sweep) -> dict[Key, Probed]:
    """Every view and site, in order, for every category; columns of an interrupted sweep are loaded."""
    keys, unfinished = (
        sweep.keys,
        SweepCheckpoint.of(sweep.run.location, sweep.settings.key, stamp_of_run(sweep.run)),
    )
    probes = {key: stored for key in keys if (stored := unfinished.read(*key)) is not None}
    progress = sweep.progress or notebook_progress("sites probed")
    columns = ((key, read_samples(sweep.run, *key)) for key in keys if key not in probes)
    for key, found in probe_columns(columns, sweep.problems, sweep.crew):
        unfinished.keep(*key, found)
        probes[key] = found
        if progress is not None:
            progress(len(probes), len(keys), f"{key[1]} {key[0]}")
    return {key: probes[key] for key in keys}


def _curve(
    run: RunReader, problem: CategoryProblem, category: str, view: str, probes: Mapping[Key, Probed]
) -> ProbeCurve:
    found = {site: probe[category] for (name, site), probe in probes.items() if name == view}
    return ProbeCurve(
        sites=tuple(found),
        labels=problem.labels,
        episodes=problem.episodes,
        items=problem.items,
        groups=problem.groups,
        fold_of=problem.fold_of,
        decisions=np.stack([probe.decisions for probe in found.values()]),
        strengths=np.stack([probe.strengths for probe in found.values()]),
        null=np.stack([probe.null for probe in found.values()]),
        inner=np.stack([sums_by_group(probe.inner, problem.groups) for probe in found.values()]).astype(
            np.float32
        ),
        parts=tuple(str(run.streams[site.stream].part) for site in found),
    )
