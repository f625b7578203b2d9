"""The features of controls: layout, step, state, action, words and pictures of the samples, without a model.

The control `random-features` is an untrained conjunction of picture and word features. Concepts recur in other
groups of pictures, so a probe can itself learn which pixels answer which word, as soon as its features hold
products of both. Any random nonlinear layer does. The control is such a layer on the pictures and the words alone,
as wide as the site it is compared with. A model that knows more than that must be better.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.runs.reader import RunReader
from probe_kit.train.builtin_columns import frames_of_inferences, why_no_sim
from probe_kit.train.results.control_scores import RANDOM_FEATURES
from probe_kit.train.solver.arrays import threads_for
from probe_kit.train.target_samples import TargetSamples

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.runs.arrays import StoredInputs
    from probe_kit.suite import Suite


PICTURED = frozenset({"pixels", RANDOM_FEATURES})
"""Controls that need pictures."""
THUMBNAIL, SIDE = 32, 12
"""Pixels along a picture: of `pixels`, and of `random-features`, enough for colours and shapes."""
LAYERS = 5
"""Random layers, whose mean is the reference: one alone is lucky or not, and the best of them is lucky."""
MOST_BINS = 50
"""The most columns of the step: neighbouring inferences of long windows share one."""

Features = NDArray[np.float32]


class ControlInputs:
    """The features of controls for n samples of a run.

    They need a suite only where a control reads its pictures; it is None elsewhere.
    """

    def __init__(self, run: RunReader, samples: TargetSamples, balanced: bool, suite: "Suite | None") -> None:
        self.run, self.samples, self.balanced, self.suite = run, samples, balanced, suite

    def features(self, name: str) -> Features:
        """Return the features (n, D) of a control other than `random-features`."""
        if name in (array_features := self.run.control_features):
            return array_features[name][self.samples.rows].astype(np.float32)
        if name == "instruction":
            return self._words()
        makers: dict[str, Callable[[], Features]] = {
            "position": self._layout,
            "step": lambda: step_features(self.samples, self._frames()),
            "state": self._state,
            "action": lambda: self._recorded_inputs("action")[:, 0].astype(np.float32),
            "pixels": lambda: self._pixels(THUMBNAIL),
        }
        return makers[name]()

    def layer(self, positions: NDArray[np.intp], width: int, seed: int) -> Features:
        """Return the outputs (E, width) of a random tanh layer for the E samples at `positions`."""
        return random_layer([part[positions] for part in self._layer_inputs], width, seed)

    @cached_property
    def _layer_inputs(self) -> list[Features]:
        """Return pictures, words and, for targets other than a side, the state where there is one.

        They are read once for all layers.
        """
        parts = [self._pixels(SIDE), word_counts(self.run)[self.samples.rows]]
        if not self.balanced and why_no_state(self.run) is None:
            parts.append(self._state())
        return parts

    def _layout(self) -> Features:
        """Return (n, 1): +1 in the original layout, −1 in the swapped one."""
        original = (self.run.episodes["layout"] == "original").to_numpy()[self.samples.rows]
        return np.where(original, np.float32(1), np.float32(-1))[:, None]

    def _words(self) -> Features:
        """Return the word counts (n, W); of a side (n, 2 W).

        The second half is the same counts times the layout's sign. It shows a word whose picture always lies on
        one side.
        """
        counts = word_counts(self.run)[self.samples.rows]
        return np.hstack([counts, counts * self._layout()]) if self.balanced else counts

    def _state(self) -> Features:
        if self.recorded is not None:
            return self._recorded_inputs("state").astype(np.float32)
        return state_features(self.run, self.samples)

    @cached_property
    def recorded(self) -> "StoredInputs | None":
        """The stored inputs of recordings and of a user's own environment."""
        inputs: StoredInputs | None = self.run.inputs
        return inputs

    def _recorded_inputs(self, kind: str) -> NDArray[Any]:
        """Return the stored inputs (n, …) of the samples, of one kind."""
        assert self.recorded is not None
        values: NDArray[Any] = self.recorded.read(kind)[self.samples.rows, self.samples.inferences]
        return values

    def _frames(self) -> NDArray[np.intp] | None:
        """Return the place (n,) of every recorded frame in the order of frames.

        It is None for scenes, and where windows begin at an event.
        """
        if self.recorded is None or self.samples.aligned is not None:
            return None
        steps = self.run.control_steps[self.samples.rows, self.samples.inferences]
        return np.asarray(np.unique(steps, return_inverse=True)[1], np.intp)

    def _pixels(self, side: int) -> Features:
        if self.recorded is not None:
            return small_pictures(self._recorded_inputs("pixels"), side)
        assert self.suite is not None, "a control that needs pictures is given the suite"
        rows, row_number = np.unique(self.samples.rows, return_inverse=True)
        return tile_pixels(self.run.episodes.iloc[rows], self.suite, side)[row_number]


def why_impossible(run: RunReader, samples: TargetSamples) -> dict[str, str]:
    """Return the reasons why the run or the target does not allow a control, by its name."""
    reasons = {}
    inputs = run.inputs
    if "layout" not in run.episodes:
        reasons["position"] = "the episodes have no layouts"
    if samples.window == 1:
        reasons["step"] = "every episode has one inference with a label"
    if (reason := why_no_state(run)) is not None:
        reasons["state"] = reason
    if inputs is None or "action" not in inputs.kinds:
        reasons["action"] = "no actions were recorded"
    if inputs is not None and "pixels" not in inputs.kinds:
        reasons |= dict.fromkeys(PICTURED, "the run was extracted with --no-pixels")
    if "instruction" not in run.episodes:
        reasons |= dict.fromkeys(("instruction", RANDOM_FEATURES), "the episodes have no column 'instruction'")
    return reasons


def why_no_state(run: RunReader) -> str | None:
    """Return why a run has no control `state`; None if it has one."""
    inputs = run.inputs
    if inputs is None:
        return why_no_sim(run)
    return None if "state" in inputs.kinds else "the data set has no state"


def word_counts(run: RunReader) -> Features:
    """Return how often each word occurs in the instruction, (E, W).

    Raises:
        UsageError: For a run without instructions.
    """
    if "instruction" not in run.episodes:
        raise UsageError(f"the episodes of {run.location} have no column 'instruction'; leave that control out")
    words = [str(text).lower().split() for text in run.episodes["instruction"]]
    vocabulary = {word: number for number, word in enumerate(sorted({word for text in words for word in text}))}
    counts = np.zeros((len(words), len(vocabulary)), np.float32)
    for row, text in enumerate(words):
        for word in text:
            counts[row, vocabulary[word]] += 1
    return counts


def tile_pixels(episodes: "pd.DataFrame", suite: "Suite", side: int) -> Features:
    """Return the left and the right picture of every episode, (E, 6 side²).

    The values are RGB from 0 to 1; each picture is `side` pixels wide.
    """
    from probe_kit.suite import Episode

    items = {item.item_id: item for item in suite.items}
    thumbnails: dict[Path, Features] = {}
    rows = []
    for item_id, layout in zip(episodes["item_id"], episodes["layout"], strict=True):
        episode = Episode(items[item_id], layout)
        pictures = [episode.picture("left"), episode.picture("right")]
        thumbnails |= {path: _thumbnail(path, side) for path in pictures if path not in thumbnails}
        rows.append(np.concatenate([thumbnails[path] for path in pictures]))
    return np.stack(rows)


def _thumbnail(path: Path, side: int) -> Features:
    from PIL import Image

    from probe_kit.suite import load_picture

    small = load_picture(path).resize((side, side), Image.Resampling.BOX)
    return np.asarray(small, np.float32).ravel() / np.float32(255)


def small_pictures(pixels: NDArray[np.uint8], side: int) -> Features:
    """Return pictures (n, cameras, 32, 32, 3) as (n, cameras · side² · 3): RGB from 0 to 1.

    Each pixel is the mean of its part of the picture.
    """
    from PIL import Image

    box = Image.Resampling.BOX
    rows = [
        np.concatenate(
            [np.asarray(Image.fromarray(picture).resize((side, side), box)).ravel() for picture in cameras]
        )
        for cameras in pixels
    ]
    return np.stack(rows).astype(np.float32) / np.float32(255)


def step_features(samples: TargetSamples, places: NDArray[np.intp] | None = None) -> Features:
    """Return the part of the window that an inference is in, one-hot (n, at most 50).

    Args:
        samples: The n samples, of which `steps` and `window` are read.
        places: (n,) places of recorded frames in the order of their numbers; used instead of the inferences. None
            for scenes, and where windows begin at an event.
    """
    steps, count = samples.steps, samples.window
    if places is not None:
        steps, count = places, int(places.max()) + 1
    bins = min(count, MOST_BINS)
    features: Features = np.eye(bins, dtype=np.float32)[steps * bins // count]
    return features


def state_features(run: RunReader, samples: TargetSamples) -> Features:
    """Return position and angles of the hand and the opening of the gripper at every inference's step, (n, 7).

    Raises:
        UsageError: For a run without control steps.
        NoTrajectoryError: For a run without trajectories.
    """
    of_row: dict[int, list[int]] = {}
    for position, row in enumerate(samples.rows.tolist()):
        of_row.setdefault(row, []).append(position)
    features = np.empty((samples.rows.size, 7), np.float32)
    for trajectory, row, frames in frames_of_inferences(run):
        for position in of_row.get(row, ()):
            frame = frames[samples.inferences[position]]
            features[position] = [*trajectory.tool[frame], trajectory.opening[frame]]
    return features


def random_layer(parts: Sequence[Features], width: int, seed: int) -> Features:
    """Return the outputs (N, width) of a random tanh layer, to which every part (N, D) gives an equal share.

    A part that is the same for all samples, such as the state at the first frame, gives nothing.
    """
    generator, mixed = np.random.default_rng(seed), []
    for part in parts:
        values = part.astype(np.float64)
        spread = values.std(axis=0)
        varying = (values - values.mean(axis=0))[:, spread > 0] / spread[spread > 0]
        weights = generator.standard_normal((varying.shape[1], width))
        with threads_for(varying):
            outputs = varying @ weights
        # Divided by the root of its width, so that a thousand pixels do not drown ten words.
        mixed.append(outputs / max(1, varying.shape[1]) ** 0.5)
    layer: Features = np.tanh(sum(mixed)).astype(np.float32)
    return layer
