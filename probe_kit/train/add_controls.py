"""Fitting the controls of stored probe results, and storing them beside."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from probe_kit.errors import UsageError
from probe_kit.identity import derive_seed
from probe_kit.train.baselines import Baseline, baseline_features
from probe_kit.train.controls import BaselineScore, TwinScore
from probe_kit.train.curve import Curve
from probe_kit.train.permutation import site_p
from probe_kit.train.problem import category_problem
from probe_kit.train.reader import RunReader
from probe_kit.train.results import ProbeResults
from probe_kit.train.samples import Samples
from probe_kit.train.scores import chance_level, correctness, group_bootstrap
from probe_kit.train.store import save_controls


def add_baselines(
    results: ProbeResults, run: RunReader, names: Sequence[Baseline], suite: Path | None
) -> ProbeResults:
    """`results` with these baselines for every category, fitted where they are not stored yet.

    Raises what `baseline_features` raises.
    """
    missing = [name for name in names if not _has(results, name)]
    if not missing:
        return results
    scores = [score for name in missing for score in _baseline_scores(results, run, name, suite)]
    found = replace(results, controls=results.controls.with_baselines(scores))
    save_controls(found, run.location)
    return found


def _has(results: ProbeResults, name: str) -> bool:
    stored = {score.category for score in results.controls.baselines if score.name == name}
    return stored == set(results.settings.categories)


def _baseline_scores(
    results: ProbeResults, run: RunReader, name: Baseline, suite: Path | None
) -> Iterator[BaselineScore]:
    settings, samples = results.settings, Samples.pooled(baseline_features(run, name, suite))
    for category in settings.categories:
        problem = category_problem(run.episodes, category, settings)
        probe = problem.probe(samples)
        right = correctness(probe.decisions, problem.labels)
        low, high = group_bootstrap(
            right[:, None], problem.groups, derive_seed("interval", settings.seed, category, name)
        )
        p = float(site_p(right.mean(keepdims=True), probe.null[None, :])[0])
        yield BaselineScore(
            name=name,
            category=category,
            accuracy=float(right.mean()),
            ci=(float(low[0]), float(high[0])),
            p=None if np.isnan(p) else p,
            chance=chance_level(problem.labels),
            n=problem.labels.size,
        )


def add_twin(results: ProbeResults, run: RunReader, twin: ProbeResults) -> ProbeResults:
    """`results` held against the same probes of a twin. Raises UsageError if the twin saw other episodes."""
    scores = [
        score for place, curve in results.curves.items() for score in _twin_scores(results, place, curve, twin)
    ]
    found = replace(results, controls=results.controls.with_twin(scores))
    save_controls(found, run.location)
    return found


def _twin_scores(
    results: ProbeResults, place: tuple[str, str], curve: Curve, twin: ProbeResults
) -> Iterator[TwinScore]:
    other = twin.curves[place]
    if other.episodes.tolist() != curve.episodes.tolist() or (other.labels != curve.labels).any():
        raise UsageError(
            f"category {place[0]!r}: the twin {twin.settings.model!r} has {other.labels.size} episodes, this run "
            f"{curve.labels.size}, and they are not the same. Extract both from the same suite."
        )
    pairs = [(row, other.sites.index(site), False) for row, site in enumerate(curve.sites) if site in other.sites]
    streams = [name for name in dict.fromkeys(site.stream for site in curve.sites) if other.stream(name).size]
    pairs += [(curve.best(stream), other.best(stream), True) for stream in streams]
    here, there = (
        c.correct[[pair[side] for pair in pairs]].T.astype(float) for side, c in enumerate((curve, other))
    )
    seed = derive_seed("twin", results.settings.seed, *place)
    low, high = group_bootstrap(here - there, curve.groups, seed)
    for column, (row, twin_row, peak) in enumerate(pairs):
        yield TwinScore(
            *place,
            site=str(curve.sites[row]),
            twin_site=str(other.sites[twin_row]),
            peak=peak,
            accuracy=float(here[:, column].mean()),
            twin_accuracy=float(there[:, column].mean()),
            difference=float((here - there)[:, column].mean()),
            ci=(float(low[column]), float(high[column])),
            twin=twin.settings.model + (" (random weights)" if twin.settings.random_weights else ""),
        )
