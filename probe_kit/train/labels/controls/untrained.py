"""The control `untrained` of a label: the same frames, through a network with random weights."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.runs.layout import DATASET
from probe_kit.statistics.paired_bootstrap import better_than_best
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.data.samples import sites_of
from probe_kit.train.labels.label_probe import LabelProbe
from probe_kit.train.labels.label_problem import LabelProblem
from probe_kit.train.labels.label_results import LabelComparison, LabelControl, LabelResults, score_interval
from probe_kit.train.labels.label_table import EPISODE
from probe_kit.train.labels.labelled_samples import LabelledSamples

UNTRAINED = "untrained"
_SHOWN = (DATASET, "suite", "scene", "seed")
"""Settings that decide which frames a network is shown."""


def same_frames(run: RunReader, untrained: RunReader, samples: LabelledSamples) -> LabelledSamples:
    """The samples by their rows in `untrained`, which was shown the same frames.

    Raises UsageError for the run itself, for other episodes, instructions or frames, and for inferences after the
    first of a network that acted: what it saw then follows from its own actions.
    """
    if run.settings_sha256 == untrained.settings_sha256:
        raise UsageError(
            f"{untrained.location} is a copy of {run.location}, which cannot be its own untrained control. "
            "Give a run of other weights"
        )
    here, there = (getattr(one, "settings", {}) for one in (run, untrained))
    if differing := [name for name in _SHOWN if _shown(here, name) != _shown(there, name)]:
        raise UsageError(
            f"the untrained control {untrained.location} has another {differing[0]} than {run.location}; expected "
            "the same frames. Extract both by the same command, one with --random-weights"
        )
    row_of = {str(name): row for row, name in enumerate(untrained.episodes[EPISODE])}
    names = run.episodes[EPISODE].astype(str).to_numpy()[samples.rows]
    if missing := [name for name in names if name not in row_of]:
        raise UsageError(
            f"the untrained control {untrained.location} has no episode {missing[0]!r}; expected all that "
            f"{run.location} has with a label. Finish it, or extract it again by the same command"
        )
    found = replace(samples, rows=np.array([row_of[name] for name in names], np.intp))
    _check_frames(run, untrained, samples, found)
    return found


def _shown(settings: Any, name: str) -> Any:
    value = settings.get(name)
    return value.get("identity", value) if isinstance(value, dict) else value


def _check_frames(run: RunReader, untrained: RunReader, samples: LabelledSamples, found: LabelledSamples) -> None:
    if "instruction" in run.episodes and "instruction" in untrained.episodes:
        texts = run.episodes["instruction"].to_numpy(str)[samples.rows]
        others = untrained.episodes["instruction"].to_numpy(str)[found.rows]
        if (differing := np.flatnonzero(texts != others)).size:
            at = int(differing[0])
            raise UsageError(
                f"the untrained control has the instruction {others[at]!r} where {run.location} has "
                f"{texts[at]!r}; expected the same. Extract both in one wording"
            )
    if getattr(run, "recorded", False):
        frames, others = (
            one.control_steps[of.rows, of.inferences]  # type: ignore[attr-defined]
            for one, of in ((run, samples), (untrained, found))
        )
        if (frames != others).any():
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


def add_untrained_control(
    results: LabelResults, problem: LabelProblem, untrained: RunReader, samples: LabelledSamples
) -> LabelResults:
    """`results` compared with the best site of every stream of `untrained`, in place of any such comparison.

    samples: as `same_frames` gives them. Raises UsageError where it lacks a stream.
    """
    before = results.controls
    scores = [score for score in before.scores if score.name != UNTRAINED]
    comparisons = [one for one in before.comparisons if one.control != UNTRAINED]
    for view, curve in results.curves.items():
        others = sites_of(untrained, view)
        for stream in dict.fromkeys(site.stream for site in curve.sites):
            probes = [
                problem.score(samples.features(untrained, view, site)) for site in others if site.stream == stream
            ]
            if not probes:
                raise UsageError(
                    f"the untrained control {untrained.location} has no {view!r} of the stream {stream}; expected "
                    "all streams of the run. Extract both by the same command"
                )
            best = max(probes, key=lambda probe: probe.metric)
            scores.append(_score(best, results, stream, view))
            comparisons += list(_compared(probes, best, results, curve.stream(stream), view, stream))
    return results.with_controls(
        replace(before, scores=tuple(scores), comparisons=tuple(comparisons), untrained=untrained.settings_sha256)
    )


def _score(best: LabelProbe, results: LabelResults, stream: str, view: str) -> LabelControl:
    own = results.settings
    interval = score_interval(best.scores, results.labels, results.groups, own.task, results.deviations)
    by_step = tuple(results.by_step(best.scores).tolist())
    return LabelControl(UNTRAINED, best.metric, interval, None, None, stream, view, by_step)


def _compared(
    probes: list[LabelProbe],
    best: LabelProbe,
    results: LabelResults,
    rows: NDArray[np.intp],
    view: str,
    stream: str,
) -> Iterator[LabelComparison]:
    curve = results.curves[view]
    seed = derive_seed("label control", results.settings.seed, UNTRAINED, view, stream)
    others = np.stack([probe.scores for probe in probes])
    p = better_than_best(curve.scores[rows], others, results.groups, seed, results.widening)
    for row, of_site in zip(rows, p, strict=True):
        yield LabelComparison(UNTRAINED, view, str(curve.sites[row]), best.metric, float(of_site))
