"""Controls of a label: the same probe on step, state, instruction, pictures, or random features."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import SuiteNotFoundError, UsageError
from probe_kit.hashing import derive_seed
from probe_kit.statistics.label_permutations import pointwise_p
from probe_kit.statistics.paired_bootstrap import better_than_reference
from probe_kit.train.choices import LABEL_CONTROLS
from probe_kit.train.choices import LabelControl as Name
from probe_kit.train.controls.baselines import THUMBNAIL, Features, tile_pixels, word_counts
from probe_kit.train.controls.random_features import LAYERS, SIDE, random_layer
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.data.run_suite import suite_of
from probe_kit.train.data.samples import Samples
from probe_kit.train.labels.builtin_columns import frames_of_inferences, why_no_sim
from probe_kit.train.labels.label_probe import LabelProbe
from probe_kit.train.labels.label_problem import LabelProblem
from probe_kit.train.labels.label_results import (
    LabelComparison,
    LabelControl,
    LabelResults,
    score_interval,
)
from probe_kit.train.labels.labelled_samples import LabelledSamples

if TYPE_CHECKING:
    from probe_kit.runs.inputs import StoredInputs
    from probe_kit.suite import Suite

RANDOM: Name = "random-features"
NOT_BY_DEFAULT: frozenset[Name] = frozenset({"action"})
"""A policy's own action is no leak: whether a site exceeds it is another question."""
PICTURED: frozenset[Name] = frozenset({"pixels", "random-features"})
MOST_BINS = 50
"""Columns that the step has at most."""
Matrix = NDArray[np.float64]


class ControlInputs:
    """What controls are made of. suite: None where no control needs pictures."""

    def __init__(self, run: RunReader, samples: LabelledSamples, suite: "Suite | None") -> None:
        self.run, self.samples, self.suite = run, samples, suite

    def features(self, name: Name) -> Features:
        """(n, D) features of a control but `random-features`. Raises UsageError where the run lacks them."""
        if name in (own := control_features(self.run)):
            return own[name][self.samples.rows].astype(np.float32)
        if name == "step":
            return step_features(self.samples, self._frames())
        if name == "state":
            if self.recorded is not None:
                return self._recorded("state").astype(np.float32)
            return state_features(self.run, self.samples)
        if name == "action":
            return self._recorded("action")[:, 0].astype(np.float32)
        if name == "instruction":
            return word_counts(self.run)[self.samples.rows]
        return self._pixels(THUMBNAIL)

    def layer(self, width: int, seed: int) -> Features:
        """(n, width) of a random tanh layer on pictures, words and, where there is one, state."""
        return random_layer(self._layer_inputs, width, seed)

    @cached_property
    def _layer_inputs(self) -> list[Features]:
        """Read once for the layers of all streams."""
        parts = [self._pixels(SIDE), self.features("instruction")]
        if why_no_state(self.run) is None:
            parts.append(self.features("state"))
        return parts

    @cached_property
    def recorded(self) -> "StoredInputs | None":
        """What was shown of recordings."""
        found: StoredInputs | None = getattr(self.run, "inputs", None)
        return found

    def _recorded(self, kind: str) -> NDArray[Any]:
        """(n, …) stored inputs of the samples."""
        assert self.recorded is not None
        found: NDArray[Any] = self.recorded.read(kind)[self.samples.rows, self.samples.inferences]
        return found

    def _frames(self) -> NDArray[np.intp] | None:
        """(n,) place of every recorded frame in the order of frames; None for scenes, and from an event on."""
        if self.recorded is None or self.samples.aligned is not None:
            return None
        steps = self.run.control_steps[self.samples.rows, self.samples.inferences]  # type: ignore[attr-defined]
        return np.asarray(np.unique(steps, return_inverse=True)[1], np.intp)

    def _pixels(self, side: int) -> Features:
        if self.recorded is not None:
            return small_pictures(self._recorded("pixels"), side)
        assert self.suite is not None, "what needs pictures is given them"
        rows, place = np.unique(self.samples.rows, return_inverse=True)
        return tile_pixels(self.run.episodes.iloc[rows], self.suite, side)[place]


def control_features(run: RunReader) -> "Mapping[str, NDArray[np.floating]]":
    """(E, D) features of controls that a run of arrays brings, by name; built-in ones of that name give way."""
    found: Mapping[str, NDArray[np.floating]] = getattr(run, "control_features", {})
    return found


def step_features(samples: LabelledSamples, places: NDArray[np.intp] | None = None) -> Features:
    """(n, at most 50): which part of the window an inference is in, one-hot.

    places: (n,) of recorded frames in the order of their numbers, which take the place of inferences.
    """
    steps, count = samples.steps, samples.window
    if places is not None:
        steps, count = places, int(places.max()) + 1
    bins = min(count, MOST_BINS)
    found: Features = np.eye(bins, dtype=np.float32)[steps * bins // count]
    return found


def small_pictures(pixels: NDArray[np.uint8], side: int) -> Features:
    """(n, cameras · side² · 3) of (n, cameras, 32, 32, 3): RGB from 0 to 1, each pixel the mean of its part."""
    from PIL import Image

    box = Image.Resampling.BOX
    rows = [
        np.concatenate([np.asarray(Image.fromarray(one).resize((side, side), box)).ravel() for one in cameras])
        for cameras in pixels
    ]
    found: Features = np.stack(rows).astype(np.float32) / np.float32(255)
    return found


def state_features(run: RunReader, samples: LabelledSamples) -> Features:
    """(n, 7): position and angles of the hand and the opening of the gripper at the step of every inference.

    Raises UsageError for a run without trajectories or control steps.
    """
    wanted: dict[int, list[int]] = {}
    for place, row in enumerate(samples.rows.tolist()):
        wanted.setdefault(row, []).append(place)
    found = np.empty((samples.rows.size, 7), np.float32)
    for seen, row, frames in frames_of_inferences(run):
        for place in wanted.get(row, ()):
            frame = frames[samples.inferences[place]]
            found[place] = [*seen.tool[frame], seen.opening[frame]]
    return found


def why_no_state(run: RunReader) -> str | None:
    """Why a run has no control `state`; None if it has one."""
    inputs = getattr(run, "inputs", None)
    if inputs is None:
        return why_no_sim(run)
    return None if "state" in inputs.kinds else "the data set has no state"


def prepare_controls(
    run: RunReader, samples: LabelledSamples, names: Sequence[str] | None, folder: Path | None
) -> tuple[tuple[Name, ...], ControlInputs, dict[str, str]]:
    """Which controls to run, what they are made of, and why a default one is left out.

    names: None for all that the run allows; a missing one is then left out, with a warning where pictures are
    missing. folder: of the run's suite, see `suite_of`. Raises UsageError for a control that was asked for and is
    unknown or not possible, and what `suite_of` raises.
    """
    own = control_features(run)
    known = (*own, *(name for name in LABEL_CONTROLS if name not in own))
    if unknown := [name for name in names or () if name not in known]:
        raise UsageError(f"control {unknown[0]!r} of a label; expected some of {', '.join(known)}")
    wanted = names if names is not None else [name for name in known if name not in NOT_BY_DEFAULT]
    asked = [cast(Name, name) for name in known if name in wanted]
    impossible = {name: why for name, why in _impossible(run, samples).items() if name not in own}
    if names is not None and (wrong := [name for name in asked if name in impossible]):
        raise UsageError(f"the control {wrong[0]!r} is not possible: {impossible[wrong[0]]}. Leave it out")
    left_out: dict[str, str] = {name: impossible[name] for name in asked if name in impossible}
    chosen = [name for name in asked if name not in impossible]
    suite = None
    if PICTURED.intersection(chosen).difference(own) and getattr(run, "inputs", None) is None:
        try:
            suite = suite_of(run, folder)
        except SuiteNotFoundError as error:
            if names is not None:
                raise
            lost = [name for name in chosen if name in PICTURED]
            warnings.warn(
                f"the controls {' and '.join(lost)} are on by default and were NOT run: {error}; or say which you "
                "want (--controls, controls=)",
                stacklevel=4,
            )
            left_out |= dict.fromkeys(lost, "the pictures of the suite were not found")
            chosen = [name for name in chosen if name not in PICTURED]
    return tuple(chosen), ControlInputs(run, samples, suite), left_out


def _impossible(run: RunReader, samples: LabelledSamples) -> dict[str, str]:
    """Why the run or the label does not allow a control, by name."""
    found = {}
    if samples.window == 1:
        found["step"] = "every episode has one inference with a label"
    if (reason := why_no_state(run)) is not None:
        found["state"] = reason
    inputs = getattr(run, "inputs", None)
    if inputs is None or "action" not in inputs.kinds:
        found["action"] = "no actions were recorded"
    if inputs is not None and "pixels" not in inputs.kinds:
        found |= dict.fromkeys(PICTURED, "the run was extracted with --no-pixels")
    if "instruction" not in run.episodes:
        found |= dict.fromkeys(("instruction", RANDOM), "the episodes have no column 'instruction'")
    return found


def add_label_controls(
    results: LabelResults,
    problem: LabelProblem,
    widths: dict[str, int],
    names: Sequence[Name],
    inputs: ControlInputs,
    left_out: dict[str, str],
) -> LabelResults:
    """`results` compared with these controls too. widths: of every stream, for `random-features`."""
    before = results.controls
    scores, comparisons = list(before.scores), list(before.comparisons)
    for name in names:
        if name in before.names:
            continue
        if name == RANDOM:
            references = {stream: _layers(inputs, problem, width, results) for stream, width in widths.items()}
            scores += [_scored(name, probes, results, stream) for stream, probes in references.items()]
        else:
            probe = problem.probe(Samples.pooled(inputs.features(name)))
            references = {stream: [probe] for stream in widths}
            scores.append(_scored(name, [probe], results))
        comparisons += list(_compared(name, references, results))
    run = {score.name for score in scores}
    missing = {name: why for name, why in {**before.left_out, **left_out}.items() if name not in run}
    return results.with_controls(
        replace(before, scores=tuple(scores), comparisons=tuple(comparisons), left_out=missing)
    )


def _layers(inputs: ControlInputs, problem: LabelProblem, width: int, results: LabelResults) -> list[LabelProbe]:
    """The probes of the random layers."""
    seeds = (derive_seed("label random features", results.settings.seed, number) for number in range(LAYERS))
    return [problem.score(inputs.layer(width, seed)) for seed in seeds]


def _mean_scores(probes: Sequence[LabelProbe]) -> NDArray[np.float64]:
    """(n,) mean over probes of the score of every sample."""
    scores: NDArray[np.float64] = np.mean([probe.scores for probe in probes], axis=0)
    return scores


def _scored(name: Name, probes: Sequence[LabelProbe], results: LabelResults, stream: str = "") -> LabelControl:
    """The mean of the probes: one, or the random layers, which have no label permutations."""
    own, scores = results.settings, _mean_scores(probes)
    null = np.mean([probe.null for probe in probes], axis=0)
    p = float(pointwise_p(np.array([scores.mean()]), null[None, :])[0])
    return LabelControl(
        name,
        float(scores.mean()),
        score_interval(scores, results.labels, results.groups, own.task, results.deviations),
        float(null.mean()) if null.size else None,
        None if np.isnan(p) else p,
        stream,
        by_step=tuple(np.mean([results.by_step(probe.scores) for probe in probes], axis=0).tolist()),
    )


def _compared(
    name: Name, references: dict[str, list[LabelProbe]], results: LabelResults
) -> Iterator[LabelComparison]:
    for view, curve in results.curves.items():
        for stream in dict.fromkeys(site.stream for site in curve.sites):
            rows, reference = curve.stream(stream), _mean_scores(references[stream])
            seed = derive_seed("label control", results.settings.seed, name, view, stream)
            p = better_than_reference(curve.scores[rows], reference, results.groups, seed, results.widening)
            for row, of_site in zip(rows, p, strict=True):
                yield LabelComparison(name, view, str(curve.sites[row]), float(reference.mean()), float(of_site))
