"""The controls that probes must exceed: features that never saw the model, and an untrained network."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit._system.types import Matrix
from probe_kit.errors import SuiteNotFoundError, UsageError
from probe_kit.hashing import derive_seed
from probe_kit.runs.layout import DATASET
from probe_kit.runs.reader import RunReader, full_name
from probe_kit.runs.run_suite import suite_of
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.statistics.folds import sums_by_group
from probe_kit.statistics.intervals import Accuracy
from probe_kit.statistics.label_permutations import p_value
from probe_kit.statistics.paired_tests import better_than_best, better_than_reference
from probe_kit.statistics.retention import t_quantile
from probe_kit.train.choices import CONTROLS, EVERYWHERE
from probe_kit.train.control_features import LAYERS, PICTURED, ControlInputs, why_impossible
from probe_kit.train.crossval.site_probe import SiteProbe
from probe_kit.train.problem import Problem
from probe_kit.train.results.control_scores import (
    RANDOM_FEATURES,
    UNTRAINED,
    ControlComparison,
    Controls,
    ControlScore,
    UntrainedScore,
)
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.samples import Samples
from probe_kit.train.target_samples import TargetSamples

# -- features that never saw the model -----------------------------------------------------------------------

SIDE_DEFAULT = (RANDOM_FEATURES, "pixels")
"""Controls of a side that are run where the suite's pictures are, unless others, or none, are requested."""
NOT_BY_DEFAULT = frozenset({"action", "position"})
"""Controls of other targets that must be asked for.

A policy's own action is no leak: whether a site exceeds it is another question. No model reads the layout: that
`position` gives a label away is a fact of the table, for which no site can be blamed.
"""
ASKED_BELOW = 0.1
"""p of a control's knowledge below which sites of a side must exceed it.

Twice the usual 0.05: weak leaks of the pictures alone were shown in 6 % of experiments at 0.05, in 5 % at 0.1.
"""
_SIDE_SEEDS = {RANDOM_FEATURES: "binding", UNTRAINED: "twin"}
"""Words in the seeds of the controls that sites of a side are compared with; of others their name.

Numbers depend on them: another word would draw other exchanges.
"""


@dataclass(frozen=True)
class PreparedControls:
    """The controls that are still to be run.

    Attributes:
        names: Names of the controls, in the order in which they run.
        inputs: Source of their features.
        left_out: Reasons why default controls cannot run, by name.
    """

    names: tuple[str, ...]
    inputs: ControlInputs
    left_out: Mapping[str, str]


def prepare_controls(
    run: RunReader,
    samples: TargetSamples,
    balanced: bool,
    names: Sequence[str] | None,
    folder: Path | None,
    stored: Controls,
    categories: Sequence[str],
) -> PreparedControls:
    """Return the controls `names` that `stored` does not have yet, before anything is probed.

    Raises as `suite_of` where pictures of the suite are needed.

    Args:
        run: Run that is probed.
        samples: Its samples of the target.
        balanced: Whether the target is a side, which has other default controls.
        names: None for the default ones. Those that are not possible are then left out, with a warning where
            pictures are missing.
        folder: Folder of the run's suite, see `suite_of`.
        stored: Controls of the stored results.
        categories: Categories for which a control must be stored.

    Raises:
        UsageError: For a control in `names` that is unknown or not possible.
    """
    array_features = run.control_features
    available = (*array_features, *(name for name in CONTROLS if name not in array_features))
    if unknown := [name for name in names or () if name not in available]:
        raise UsageError(f"unknown control {unknown[0]!r}; expected some of {', '.join(available)}")
    default = SIDE_DEFAULT if balanced else tuple(name for name in available if name not in NOT_BY_DEFAULT)
    ordered = [name for name in available if name in (default if names is None else names)]
    reasons = {name: why for name, why in why_impossible(run, samples).items() if name not in array_features}
    if names is not None and (wrong := [name for name in ordered if name in reasons]):
        raise UsageError(f"the control {wrong[0]!r} is not possible: {reasons[wrong[0]]}. Leave it out")
    left_out = {name: reasons[name] for name in ordered if name in reasons}
    missing = [name for name in ordered if name not in reasons and not stored.has(name, categories)]
    suite = None
    if (PICTURED & set(missing)) - set(array_features) and run.inputs is None:
        try:
            suite = suite_of(run, folder)
        except SuiteNotFoundError as error:
            if names is not None:
                raise
            lost = [name for name in missing if name in PICTURED]
            subject = f"control {lost[0]} is" if len(lost) == 1 else f"controls {' and '.join(lost)} are"
            judged = (
                ", so that a signal is judged against chance only" if balanced and RANDOM_FEATURES in lost else ""
            )
            warnings.warn(
                f"the {subject} on by default and NOT run{judged}: {error}; or say that you want none (--controls "
                "none, controls=())",
                stacklevel=3,
            )
            left_out |= dict.fromkeys(lost, "the pictures of the suite were not found")
            missing = [name for name in missing if name not in PICTURED]
    return PreparedControls(tuple(missing), ControlInputs(run, samples, balanced, suite), left_out)


def add_controls(
    results: ProbeResults, problems: Mapping[str, Problem], widths: Mapping[str, int], prepared: PreparedControls
) -> ProbeResults:
    """Return `results` with these controls for every category.

    Every site is compared with `random-features`. Sites of a target other than a side are compared with every
    control, those of a side with every one that `is_informative`.

    Args:
        results: Results without these controls.
        problems: Probing problems, by category.
        widths: Width of every stream, which the layers of `random-features` take.
        prepared: Controls to fit.
    """
    before = results.controls
    missing = {**before.left_out, **prepared.left_out}
    controls = replace(before, left_out={name: why for name, why in missing.items() if name not in before.names})
    seed = results.settings.seed
    for name in prepared.names:
        # Random layers are made per stream, as wide as it: a wider layer decodes more, whatever it holds.
        features = None if name == RANDOM_FEATURES else Samples.pooled(prepared.inputs.features(name))
        for category, problem in problems.items():
            if features is None:
                references = {
                    stream: problem.control_curve(_layer_probes(prepared.inputs, problem, width, seed))
                    for stream, width in widths.items()
                }
                # Of a side one score, as wide as the backbone: the table of leaks has no streams.
                scored = references
                if problem.balanced:
                    scored = {"": references.get("backbone", next(iter(references.values())))}
            else:
                reference = problem.control_curve([problem.probe(features)])
                references, scored = dict.fromkeys(widths, reference), {"": reference}
            scores = [control_score(name, category, curve, stream) for stream, curve in scored.items()]
            compared: list[ControlComparison] = []
            is_compared = name == RANDOM_FEATURES or not problem.balanced
            if not is_compared and references:
                reference = next(iter(references.values()))  # the same for all streams
                is_compared = is_informative(reference.inner[0], reference.labels, reference.groups)
            if is_compared:
                compared = [
                    comparison
                    for (curve_category, view), curve in results.curves.items()
                    for stream in (curve.streams if curve_category == category else ())
                    for comparison in _compare_sites(
                        results, name, (category, view), stream, references[stream].scores
                    )
                ]
            controls = controls.with_scores(scores, compared)
    return replace(results, controls=controls)


def is_informative(inner: NDArray[np.floating], labels: NDArray[np.bool_], groups: ArrayLike) -> bool:
    """Return whether the inner folds of a control's probe of a side know more than the shares of the sides.

    They do if their log-likelihood is above that of the shares, by Student's one-sided test with groups as the
    unit, at `ASKED_BELOW`. The outer folds, on which sites are compared, do not take part: a control that happens
    to score well is not chosen for that.

    Args:
        inner: (F, G) log-likelihood of every group in the inner folds of each outer fold, 0 for the groups that
            the outer fold tests.
        labels: (E,) side of every episode.
        groups: (E,) group of items of every episode.
    """
    share = float(labels.mean())
    entropy = -sum(part * log(part) for part in (share, 1 - share) if part > 0)
    # Every group is in the inner folds of all outer folds but its own.
    gains = inner.sum(axis=0) / (len(inner) - 1) + entropy * sums_by_group(np.ones(labels.size), groups)
    quantile = t_quantile(gains.size - 1, ASKED_BELOW)
    return bool(gains.mean() > quantile * gains.std(ddof=1) / sqrt(gains.size))


def _layer_probes(inputs: ControlInputs, problem: Problem, width: int, seed: int) -> list[SiteProbe]:
    """Return the probes of the random layers, without label permutations."""
    # Words of seeds, which numbers depend on: another word would draw other layers.
    kind = "binding" if problem.balanced else "label random features"
    layers = (inputs.layer(problem.positions, width, derive_seed(kind, seed, number)) for number in range(LAYERS))
    return [problem.fit(Samples.pooled(layer)) for layer in layers]


def control_score(name: str, category: str, curve: ProbeCurve, stream: str = "", view: str = "") -> ControlScore:
    """Return the mean score of the probes of a control, with p where a single one has label permutations."""
    score, limits = curve.estimate(np.arange(len(curve.sites)))
    p = float(p_value(curve.metric.mean(keepdims=True), curve.null.mean(axis=0)[None, :])[0])
    chance = float(curve.chance.mean())
    by_step = (
        np.mean([curve.by_step(scores) for scores in curve.scores], axis=0) if not curve.balanced else np.empty(0)
    )
    return ControlScore(
        name=name,
        category=category,
        score=score,
        ci=limits,
        p=None if np.isnan(p) else p,
        chance=None if np.isnan(chance) else chance,
        n=curve.labels.size,
        stream=stream,
        view=view,
        by_step=tuple(by_step.tolist()),
    )


def _compare_sites(
    results: ProbeResults, name: str, key: tuple[str, str], stream: str, references: Matrix
) -> Iterator[ControlComparison]:
    """Yield every site of a stream against the mean of a control's scores, or the best untrained site.

    Args:
        results: Probes whose sites are compared.
        name: Name of the control; `UNTRAINED` compares with the best site of `references`.
        key: Category and view.
        stream: Stream of the sites.
        references: (S', E) scores of the control's S' sites on the E samples.
    """
    curve, settings = results.curves[key], results.settings
    rows = curve.stream(stream)
    if settings.balanced:
        seed = derive_seed(_SIDE_SEEDS.get(name, name), settings.seed, *key, stream)
    else:
        scope = key[1:] if settings.categories == (EVERYWHERE,) else key
        seed = derive_seed("label control", settings.seed, name, *scope, stream)
    chance = 1 / len(curve.classes) if curve.classes else CHANCE
    if name == UNTRAINED:
        level = float(references.mean(axis=1).max())
        p = better_than_best(curve.scores[rows], references, curve.groups, seed, curve.widening, chance)
    else:
        reference = references.mean(axis=0)
        level = float(reference.mean())
        p = better_than_reference(curve.scores[rows], reference, curve.groups, seed, curve.widening, chance)
    for row, of_site in zip(rows, p, strict=True):
        yield ControlComparison(name, *key, str(curve.sites[row]), level, float(of_site))


# -- an untrained network ------------------------------------------------------------------------------------

_SHOWN = (DATASET, "suite", "scene", "seed")
"""Settings that decide which frames a network is shown."""


def check_same_source(run: RunReader, untrained: RunReader, samples: TargetSamples, balanced: bool) -> None:
    """Raise UsageError if `untrained` is the run itself.

    For a target other than a side, also raise it for other frames and for missing episodes.

    Args:
        run: Run that is probed.
        untrained: Run to compare with.
        samples: Samples of `run`.
        balanced: Whether the target is a side.
    """
    if run.location.address == untrained.location.address:
        raise UsageError(
            f"{run.location} cannot be its own untrained control; give another run of the same episodes"
        )
    if balanced:
        return
    if differing := [name for name in _SHOWN if _identity(run, name) != _identity(untrained, name)]:
        raise UsageError(
            f"the untrained control {untrained.location} has another {differing[0]} than {run.location}; expected "
            "the same frames. Extract both by the same command, one with --random-weights"
        )
    names = run.episodes["episode_id"].to_numpy(str)[samples.rows]
    missing = names[~np.isin(names, untrained.episodes["episode_id"].to_numpy(str))]
    if missing.size:
        raise UsageError(
            f"the untrained control {untrained.location} has no episode {str(missing[0])!r}; expected all that "
            f"{run.location} has with a label. Finish it, or extract it again by the same command"
        )


def check_untrained(
    run: RunReader,
    untrained: RunReader,
    samples: TargetSamples,
    untrained_samples: TargetSamples,
    balanced: bool,
    call: int,
) -> None:
    """Raise UsageError unless `untrained` is another run of the same episodes, instructions, frames and labels.

    For a target other than a side, also raise it for inferences after the first of a network that acted. The
    frames it was shown then follow from its own actions.

    Args:
        run: Run that is probed.
        untrained: Run to compare with.
        samples: Samples of `run`.
        untrained_samples: Samples of `untrained`.
        balanced: Whether the target is a side.
        call: Captured inference that is probed, counted from 0; it appears in the advice of the error.
    """
    identities, untrained_identities = (
        _identities(*pair) for pair in ((run, samples), (untrained, untrained_samples))
    )
    if identities != untrained_identities:
        advice = "Extract both by the same command, one with --random-weights"
        if call > 0:
            advice = (
                f"Not the same episodes got as far as captured inference {call}: leave --call or --untrained out"
            )
        pairs = zip(identities, untrained_identities, strict=False)
        differing = next((f"; the first is {first!r}" for first, second in pairs if first != second), "")
        raise UsageError(
            f"the untrained control {untrained.model!r} has {len(untrained_identities)} samples to probe, "
            f"{run.model!r} has {len(identities)}, and they are not the same in episode, instruction and "
            f"label{differing}. {advice}."
        )
    if run.settings_sha256 == untrained.settings_sha256:
        raise UsageError(
            f"{untrained.location} is a copy of {run.location}, which cannot be its own untrained control; "
            "give a run of other weights"
        )
    if run.recorded and not balanced:
        frames, other_frames = (
            reader.control_steps[reader_samples.rows, reader_samples.inferences]
            for reader, reader_samples in ((run, samples), (untrained, untrained_samples))
        )
        if (frames != other_frames).any():
            raise UsageError(
                f"the untrained control {untrained.location} shows other frames than {run.location}. Extract both "
                "with the same --select"
            )
    elif not balanced and samples.inferences.any():
        raise UsageError(
            f"an untrained control of labels after the first inference: the network of {untrained.location} acted "
            "otherwise, so it saw other frames. Expected labels of whole episodes at --call 0, --window 1, or "
            "recordings"
        )


def _identities(run: RunReader, samples: TargetSamples) -> list[tuple[str, str, int, float]]:
    """Return id, instruction, inference and label of every sample, which two runs must have in common."""
    names = run.episodes["episode_id"].to_numpy(str)[samples.rows].tolist()
    texts = [""] * len(names)
    if "instruction" in run.episodes:
        texts = run.episodes["instruction"].to_numpy(str)[samples.rows].tolist()
    return list(zip(names, texts, samples.inferences.tolist(), samples.values.tolist(), strict=True))


def _identity(run: RunReader, name: str) -> Any:
    value = run.settings.get(name)
    return value.get("identity", value) if isinstance(value, dict) else value


def add_untrained(results: ProbeResults, untrained: ProbeResults) -> ProbeResults:
    """Return `results` compared with the same probes of an untrained network, in place of any other one.

    Raises:
        UsageError: For other episodes, and for a stream that the untrained network lacks.
    """
    gains: list[UntrainedScore] = []
    scores: list[ControlScore] = []
    compared: list[ControlComparison] = []
    for key, curve in results.curves.items():
        other = untrained.curves[key]
        if other.episodes.tolist() != curve.episodes.tolist() or (other.labels != curve.labels).any():
            raise UsageError(
                f"category {key[0]!r}: the untrained control {untrained.label!r} has {other.labels.size} "
                f"episodes, this run {curve.labels.size}, and they are not the same. Extract both from the same "
                "suite."
            )
        if curve.balanced:
            gains += _gains(key, curve, other, untrained)
        for stream in curve.streams:
            if not (other_rows := other.stream(stream)).size:
                raise UsageError(
                    f"the untrained control {untrained.label!r} has no {key[1]!r} of the stream {stream}; "
                    "expected all streams of the run. Extract both by the same command"
                )
            if not curve.balanced:
                best = other.only(other.best(stream))
                scores.append(replace(control_score(UNTRAINED, key[0], best, stream, key[1]), chance=None, p=None))
            compared += _compare_sites(results, UNTRAINED, key, stream, other.scores[other_rows])
    controls = results.controls.with_untrained(gains, untrained.settings.key).with_scores(scores, compared)
    return replace(results, controls=controls)


def _gains(
    key: tuple[str, str], curve: ProbeCurve, other: ProbeCurve, untrained: ProbeResults
) -> Iterator[UntrainedScore]:
    """Yield the gain of every site, and of the best one of every stream."""
    pairs = [(row, other.sites.index(site), False) for row, site in enumerate(curve.sites) if site in other.sites]
    streams = [name for name in curve.streams if other.stream(name).size]
    pairs += [(curve.best(stream), other.best(stream), True) for stream in streams]
    correct, untrained_correct = (
        c.correct[[pair[side] for pair in pairs]].T.astype(float) for side, c in enumerate((curve, other))
    )
    for column, (row, untrained_row, peak) in enumerate(pairs):
        hits, untrained_hits = correct[:, column], untrained_correct[:, column]
        gap = Accuracy.of(hits, curve.groups).difference(Accuracy.of(untrained_hits, curve.groups))
        yield UntrainedScore(
            *key,
            site=str(curve.sites[row]),
            untrained_site=str(other.sites[untrained_row]),
            peak=peak,
            accuracy=float(hits.mean()),
            untrained_accuracy=float(untrained_hits.mean()),
            difference=float((correct - untrained_correct)[:, column].mean()),
            ci=(gap.low, gap.high),
            untrained=full_name(untrained.label, untrained.settings.random_weights),
        )
