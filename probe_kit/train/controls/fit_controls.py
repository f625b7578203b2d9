"""Fitting of controls for probe results, with all checks before the first fit."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import SuiteNotFoundError, UsageError
from probe_kit.hashing import derive_seed
from probe_kit.statistics.estimates.balanced import CHANCE
from probe_kit.statistics.estimates.shares import Accuracy
from probe_kit.statistics.label_permutations import pointwise_p
from probe_kit.statistics.paired_bootstrap import better_than_best
from probe_kit.train.choices import Baseline
from probe_kit.train.controls.baselines import DEFAULT, PICTURED, baseline_features
from probe_kit.train.controls.random_features import RandomFeatureInputs, random_feature_scores
from probe_kit.train.crossval.category_problem import POOLED, category_problem
from probe_kit.train.crossval.metrics import correctness
from probe_kit.train.data.labels import target_labels
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.data.run_suite import suite_of
from probe_kit.train.data.samples import Samples
from probe_kit.train.results.control_scores import (
    RANDOM_FEATURES,
    UNTRAINED,
    BaselineScore,
    ControlComparison,
    UntrainedScore,
)
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.settings import ProbeSettings


@dataclass(frozen=True)
class PreparedControls:
    """Baselines that are still to be probed: features (E, D) by name, and the input of `random-features`."""

    features: Mapping[Baseline, NDArray[np.float32]]
    random_features: RandomFeatureInputs | None


def prepare_baselines(
    run: RunReader, names: Sequence[Baseline] | None, folder: Path | None, stored: ProbeResults | None
) -> PreparedControls:
    """Features of the baselines `names` that `stored` does not have yet.

    names: None for `DEFAULT`, which is left out, with a warning, where its pictures cannot be found. folder: of
    the run's suite, see `suite_of`. Before anything is probed, so that what is wrong with them is said first.
    Raises what `baseline_features` and `suite_of` raise.
    """
    missing = [name for name in (DEFAULT if names is None else names) if stored is None or not _has(stored, name)]
    suite = None
    if PICTURED.intersection(missing):
        try:
            suite = suite_of(run, folder)
        except SuiteNotFoundError as error:
            if names is not None:
                raise
            _warn_of_no_control(missing, error)
            missing = []
    features = {name: baseline_features(run, name, suite) for name in missing if name != RANDOM_FEATURES}
    random_features = (
        RandomFeatureInputs.of(run, suite) if suite is not None and RANDOM_FEATURES in missing else None
    )
    return PreparedControls(features, random_features)


def _warn_of_no_control(left_out: Sequence[Baseline], reason: SuiteNotFoundError) -> None:
    names = f"control {left_out[0]} is" if len(left_out) == 1 else f"controls {' and '.join(left_out)} are"
    judged = ", so that a signal is judged against chance only" if RANDOM_FEATURES in left_out else ""
    warnings.warn(
        f"the {names} on by default and NOT run{judged}: {reason}; or say that you want none (--controls none, "
        "controls=())",
        stacklevel=4,
    )


def add_baselines(results: ProbeResults, run: RunReader, prepared: PreparedControls) -> ProbeResults:
    """`results` with these baselines for every category; `random-features` is compared with every site."""
    controls = results.controls
    for name, features in prepared.features.items():
        controls = controls.with_baselines(_baseline_scores(results, run, name, features))
    if prepared.random_features is not None:
        scores, excess = random_feature_scores(results, run, prepared.random_features)
        controls = controls.with_baselines(scores).with_excess(excess)
    return replace(results, controls=controls)


def _has(results: ProbeResults, name: str) -> bool:
    stored = {score.category for score in results.controls.baselines if score.name == name}
    return stored == set(results.settings.categories)


def _baseline_scores(
    results: ProbeResults, run: RunReader, name: Baseline, features: NDArray[np.float32]
) -> Iterator[BaselineScore]:
    settings, samples = results.settings, Samples.pooled(features)
    for category in settings.categories:
        problem = category_problem(run.episodes, category, settings)
        probe = problem.probe(samples)
        right = correctness(probe.decisions, problem.labels)
        share = problem.accuracy(probe.decisions)
        p = float(pointwise_p(right.mean(keepdims=True), probe.null[None, :])[0])
        yield BaselineScore(
            name=name,
            category=category,
            accuracy=share.value,
            ci=(share.interval().low, share.interval().high),
            p=None if np.isnan(p) else p,
            chance=CHANCE,
            n=problem.labels.size,
        )


def check_untrained(run: RunReader, untrained: RunReader, settings: ProbeSettings) -> None:
    """Raise UsageError unless `untrained` is another run of the same episodes with the same labels."""
    if run.location.address == untrained.location.address:
        raise UsageError(
            f"{run.location} cannot be its own untrained control; give another run of the same episodes"
        )
    here, there = (_labels_by_episode(one, settings) for one in (run, untrained))
    if here != there:
        advice = "Extract both from the same suite"
        if settings.call > 0:
            reached = f"Not the same episodes got as far as captured inference {settings.call}"
            advice = f"{reached}: leave --call or --untrained out"
        raise UsageError(
            f"the untrained control {untrained.model!r} has {len(there)} episodes to probe, "
            f"{run.model!r} has {len(here)}, and they are not the same. {advice}."
        )
    if run.settings_sha256 == untrained.settings_sha256:
        raise UsageError(
            f"{untrained.location} is a copy of {run.location}, which cannot be its own untrained control; "
            "give other weights"
        )


def _labels_by_episode(run: RunReader, settings: ProbeSettings) -> list[tuple[str, str, int]]:
    """Id, instruction and label of every episode that is probed: what two runs must have in common."""
    labels = target_labels(run.episodes, settings.target, settings.seed)
    chosen = run.episodes["category"].isin(settings.categories) | (POOLED in settings.categories)
    names, asked = (
        run.episodes["episode_id"].astype(str),
        run.episodes.get("instruction", run.episodes["episode_id"]),
    )
    return [
        (name, str(instruction), label)
        for name, instruction, label, kept in zip(names, asked, labels.tolist(), chosen, strict=True)
        if kept and label >= 0
    ]


def add_untrained(results: ProbeResults, untrained: ProbeResults) -> ProbeResults:
    """`results` compared with the same probes of an untrained network.

    Raises UsageError if that one saw other episodes.
    """
    scores = [
        score for place, curve in results.curves.items() for score in _untrained_scores(place, curve, untrained)
    ]
    excess = [
        one
        for place, curve in results.curves.items()
        for one in _untrained_excess(results, place, curve, untrained)
    ]
    return replace(results, controls=results.controls.with_untrained(scores).with_excess(excess))


def _untrained_excess(
    results: ProbeResults, place: tuple[str, str], curve: ProbeCurve, untrained: ProbeResults
) -> Iterator[ControlComparison]:
    """Every site of a stream against the best of the untrained network's."""
    other = untrained.curves[place]
    for stream in dict.fromkeys(site.stream for site in curve.sites):
        if not other.stream(stream).size:
            continue
        rows, others = curve.stream(stream), other.correct[other.stream(stream)]
        seed = derive_seed("twin", results.settings.seed, *place, stream)
        p = better_than_best(curve.correct[rows], others, curve.groups, seed)
        best = float(others.mean(axis=1).max())
        for row, of_site in zip(rows, p, strict=True):
            yield ControlComparison(UNTRAINED, *place, str(curve.sites[row]), best, float(of_site))


def _untrained_scores(
    place: tuple[str, str], curve: ProbeCurve, untrained: ProbeResults
) -> Iterator[UntrainedScore]:
    other = untrained.curves[place]
    if other.episodes.tolist() != curve.episodes.tolist() or (other.labels != curve.labels).any():
        raise UsageError(
            f"category {place[0]!r}: the untrained control {untrained.label!r} has {other.labels.size} "
            f"episodes, this run {curve.labels.size}, and they are not the same. Extract both from the same suite."
        )
    pairs = [(row, other.sites.index(site), False) for row, site in enumerate(curve.sites) if site in other.sites]
    streams = [name for name in dict.fromkeys(site.stream for site in curve.sites) if other.stream(name).size]
    pairs += [(curve.best(stream), other.best(stream), True) for stream in streams]
    here, there = (
        c.correct[[pair[side] for pair in pairs]].T.astype(float) for side, c in enumerate((curve, other))
    )
    for column, (row, untrained_row, peak) in enumerate(pairs):
        yield UntrainedScore(
            *place,
            site=str(curve.sites[row]),
            untrained_site=str(other.sites[untrained_row]),
            peak=peak,
            accuracy=float(here[:, column].mean()),
            untrained_accuracy=float(there[:, column].mean()),
            difference=float((here - there)[:, column].mean()),
            ci=_gain_limits(here[:, column], there[:, column], curve.groups),
            untrained=untrained.label + (" (random weights)" if untrained.settings.random_weights else ""),
        )


def _gain_limits(
    here: NDArray[np.float64], there: NDArray[np.float64], groups: NDArray[np.str_]
) -> tuple[float, float]:
    """95 % interval of the difference of two accuracies on the same episodes."""
    gap = Accuracy.of(here, groups).difference(Accuracy.of(there, groups))
    return gap.low, gap.high
