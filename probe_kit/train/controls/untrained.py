"""The control `untrained`: the same probes of a network with random weights, on the same episodes."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.runs.layout import DATASET
from probe_kit.runs.reader import RunReader, full_name
from probe_kit.statistics.estimates.shares import Accuracy
from probe_kit.statistics.paired_bootstrap import better_than_best
from probe_kit.train.controls.fit import comparison_seed, comparisons, control_score
from probe_kit.train.results.control_scores import UNTRAINED, ControlComparison, ControlScore, UntrainedScore
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.target_samples import TargetSamples

_SHOWN = (DATASET, "suite", "scene", "seed")
"""Settings that decide which frames a network is shown."""


def check_same_source(run: RunReader, untrained: RunReader, samples: TargetSamples, is_side: bool) -> None:
    """Raise UsageError for the run itself; of a target that is no side also for other frames or missing episodes.

    samples: of the run.
    """
    if run.location.address == untrained.location.address:
        raise UsageError(
            f"{run.location} cannot be its own untrained control; give another run of the same episodes"
        )
    if is_side:
        return
    _check_settings(run, untrained)
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
    is_side: bool,
    call: int,
) -> None:
    """Raise UsageError unless `untrained` is another run of the same episodes, instructions, frames and labels.

    samples, untrained_samples: of the two runs. Of a target that is no side also for inferences after the first of
    a network that acted: the frames it was shown then follow from its own actions.
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
    if not is_side:
        _check_frames(run, untrained, samples, untrained_samples)


def _identities(run: RunReader, samples: TargetSamples) -> list[tuple[str, str, int, float]]:
    """Id, instruction, inference and label of every sample: what two runs must have in common."""
    names = run.episodes["episode_id"].to_numpy(str)[samples.rows].tolist()
    texts = [""] * len(names)
    if "instruction" in run.episodes:
        texts = run.episodes["instruction"].to_numpy(str)[samples.rows].tolist()
    return list(zip(names, texts, samples.inferences.tolist(), samples.values.tolist(), strict=True))


def _check_settings(run: RunReader, untrained: RunReader) -> None:
    if differing := [name for name in _SHOWN if _identity(run, name) != _identity(untrained, name)]:
        raise UsageError(
            f"the untrained control {untrained.location} has another {differing[0]} than {run.location}; expected "
            "the same frames. Extract both by the same command, one with --random-weights"
        )


def _identity(run: RunReader, name: str) -> Any:
    value = run.settings.get(name)
    return value.get("identity", value) if isinstance(value, dict) else value


def _check_frames(
    run: RunReader, untrained: RunReader, samples: TargetSamples, untrained_samples: TargetSamples
) -> None:
    if run.recorded:
        frames, other_frames = (
            reader.control_steps[reader_samples.rows, reader_samples.inferences]
            for reader, reader_samples in ((run, samples), (untrained, untrained_samples))
        )
        if (frames != other_frames).any():
            raise UsageError(
                f"the untrained control {untrained.location} shows other frames than {run.location}. Extract both "
                "with the same --select"
            )
    elif samples.inferences.any():
        raise UsageError(
            f"an untrained control of labels after the first inference: the network of {untrained.location} acted "
            "otherwise, so it saw other frames. Expected labels of whole episodes at --call 0, --window 1, or "
            "recordings"
        )


def add_untrained(results: ProbeResults, untrained: ProbeResults) -> ProbeResults:
    """Return `results` compared with the same probes of an untrained network, in place of any other one.

    Raises UsageError for other episodes, and for a stream that the untrained network lacks.
    """
    gains: list[UntrainedScore] = []
    scores: list[ControlScore] = []
    compared: list[ControlComparison] = []
    for key, curve in results.curves.items():
        other = untrained.curves[key]
        _check_samples(key[0], curve, other, untrained.label)
        if curve.is_side:
            gains += _gains(key, curve, other, untrained)
        for stream in curve.streams:
            if not (other_rows := other.stream(stream)).size:
                raise UsageError(
                    f"the untrained control {untrained.label!r} has no {key[1]!r} of the stream {stream}; "
                    "expected all streams of the run. Extract both by the same command"
                )
            if not curve.is_side:
                best = replace(other, **_only(other, other.best(stream)))
                scores.append(replace(control_score(UNTRAINED, key[0], best, stream, key[1]), chance=None, p=None))
            compared += _compared(results, key, stream, other.scores[other_rows])
    controls = results.controls.with_untrained(gains).with_scores(scores, compared)
    return replace(results, controls=controls)


def _only(curve: ProbeCurve, row: int) -> dict[str, Any]:
    """The members of a curve with a single one of its sites."""
    members = ("decisions", "strengths", "null", "inner", "sample_scores")
    arrays = {name: getattr(curve, name)[[row]] for name in members if getattr(curve, name) is not None}
    return {"sites": (curve.sites[row],), "parts": (curve.parts[row],), **arrays}


def _check_samples(category: str, curve: ProbeCurve, other: ProbeCurve, name: str) -> None:
    if other.episodes.tolist() != curve.episodes.tolist() or (other.labels != curve.labels).any():
        raise UsageError(
            f"category {category!r}: the untrained control {name!r} has {other.labels.size} "
            f"episodes, this run {curve.labels.size}, and they are not the same. Extract both from the same suite."
        )


def _compared(
    results: ProbeResults, key: tuple[str, str], stream: str, other_scores: NDArray[np.float64]
) -> Iterator[ControlComparison]:
    """Yield every site of a stream against the best of the untrained network's."""
    curve = results.curves[key]
    rows, seed = curve.stream(stream), comparison_seed(results.settings, UNTRAINED, *key, stream)
    p = better_than_best(curve.scores[rows], other_scores, curve.groups, seed, curve.widening)
    yield from comparisons(UNTRAINED, *key, curve, rows, float(other_scores.mean(axis=1).max()), p)


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
