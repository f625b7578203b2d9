"""The control `untrained`: the same probes of a network with random weights, on the same episodes."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.runs.layout import DATASET
from probe_kit.statistics.estimates.shares import Accuracy
from probe_kit.statistics.paired_bootstrap import better_than_best
from probe_kit.train.controls.fit import comparison_seed, comparisons, control_score
from probe_kit.train.data.run_reader import RunReader
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
    run: RunReader, untrained: RunReader, samples: TargetSamples, others: TargetSamples, is_side: bool, call: int
) -> None:
    """Raise UsageError unless `untrained` is another run of the same episodes, instructions, frames and labels.

    samples, others: of the two runs. Of a target that is no side also for inferences after the first of a network
    that acted: the frames it was shown then follow from its own actions.
    """
    own, other = (_identities(*pair) for pair in ((run, samples), (untrained, others)))
    if own != other:
        advice = "Extract both by the same command, one with --random-weights"
        if call > 0:
            advice = (
                f"Not the same episodes got as far as captured inference {call}: leave --call or --untrained out"
            )
        differing = next((f"; the first is {a[0]!r}" for a, b in zip(own, other, strict=False) if a != b), "")
        raise UsageError(
            f"the untrained control {untrained.model!r} has {len(other)} samples to probe, {run.model!r} has "
            f"{len(own)}, and they are not the same in episode, instruction and label{differing}. {advice}."
        )
    if run.settings_sha256 == untrained.settings_sha256:
        raise UsageError(
            f"{untrained.location} is a copy of {run.location}, which cannot be its own untrained control; "
            "give a run of other weights"
        )
    if not is_side:
        _check_frames(run, untrained, samples, others)


def _identities(run: RunReader, samples: TargetSamples) -> list[tuple[str, str, int, float]]:
    """Id, instruction, inference and label of every sample: what two runs must have in common."""
    names = run.episodes["episode_id"].to_numpy(str)[samples.rows].tolist()
    texts = [""] * len(names)
    if "instruction" in run.episodes:
        texts = run.episodes["instruction"].to_numpy(str)[samples.rows].tolist()
    return list(zip(names, texts, samples.inferences.tolist(), samples.values.tolist(), strict=True))


def _check_settings(run: RunReader, untrained: RunReader) -> None:
    own, other = (getattr(one, "settings", {}) for one in (run, untrained))
    if differing := [name for name in _SHOWN if _identity(own, name) != _identity(other, name)]:
        raise UsageError(
            f"the untrained control {untrained.location} has another {differing[0]} than {run.location}; expected "
            "the same frames. Extract both by the same command, one with --random-weights"
        )


def _identity(settings: Any, name: str) -> Any:
    value = settings.get(name)
    return value.get("identity", value) if isinstance(value, dict) else value


def _check_frames(run: RunReader, untrained: RunReader, samples: TargetSamples, others: TargetSamples) -> None:
    if getattr(run, "recorded", False):
        frames, other_frames = (
            one.control_steps[of.rows, of.inferences]  # type: ignore[attr-defined]
            for one, of in ((run, samples), (untrained, others))
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
    for place, curve in results.curves.items():
        other = untrained.curves[place]
        _check_samples(place[0], curve, other, untrained.label)
        if curve.is_side:
            gains += _gains(place, curve, other, untrained)
        for stream in curve.streams:
            if not (others := other.stream(stream)).size:
                raise UsageError(
                    f"the untrained control {untrained.label!r} has no {place[1]!r} of the stream {stream}; "
                    "expected all streams of the run. Extract both by the same command"
                )
            if not curve.is_side:
                best = replace(other, **_only(other, other.best(stream)))
                scores.append(
                    replace(control_score(UNTRAINED, place[0], best, stream, place[1]), chance=None, p=None)
                )
            compared += _compared(results, place, stream, other.scores[others])
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
    results: ProbeResults, place: tuple[str, str], stream: str, others: NDArray[np.float64]
) -> Iterator[ControlComparison]:
    """Yield every site of a stream against the best of the untrained network's."""
    curve = results.curves[place]
    rows, seed = curve.stream(stream), comparison_seed(results.settings, UNTRAINED, *place, stream)
    p = better_than_best(curve.scores[rows], others, curve.groups, seed, curve.widening)
    yield from comparisons(UNTRAINED, *place, curve, rows, float(others.mean(axis=1).max()), p)


def _gains(
    place: tuple[str, str], curve: ProbeCurve, other: ProbeCurve, untrained: ProbeResults
) -> Iterator[UntrainedScore]:
    """Yield the gain of every site, and of the best one of every stream."""
    pairs = [(row, other.sites.index(site), False) for row, site in enumerate(curve.sites) if site in other.sites]
    streams = [name for name in curve.streams if other.stream(name).size]
    pairs += [(curve.best(stream), other.best(stream), True) for stream in streams]
    own, others = (
        c.correct[[pair[side] for pair in pairs]].T.astype(float) for side, c in enumerate((curve, other))
    )
    for column, (row, untrained_row, peak) in enumerate(pairs):
        here, there = own[:, column], others[:, column]
        gap = Accuracy.of(here, curve.groups).difference(Accuracy.of(there, curve.groups))
        yield UntrainedScore(
            *place,
            site=str(curve.sites[row]),
            untrained_site=str(other.sites[untrained_row]),
            peak=peak,
            accuracy=float(here.mean()),
            untrained_accuracy=float(there.mean()),
            difference=float((own - others)[:, column].mean()),
            ci=(gap.low, gap.high),
            untrained=untrained.label + (" (random weights)" if untrained.settings.random_weights else ""),
        )
