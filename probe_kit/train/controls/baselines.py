"""Baselines without a model: features of layout, instruction and pictures alone."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.train.choices import BASELINES, Baseline
from probe_kit.train.data.run_reader import RunReader

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.suite import Suite

PICTURED: frozenset[Baseline] = frozenset({"pixels", "random-features"})
"""Those that need the pictures of the run's suite."""
DEFAULT: tuple[Baseline, ...] = ("random-features", "pixels")
"""Those that are run where the suite's pictures are, unless others, or none, are requested."""
THUMBNAIL = 32

Features = NDArray[np.float32]


def baseline_features(run: RunReader, name: Baseline, suite: "Suite | None") -> Features:
    """(E, D) features of a baseline but `random-features`, rows in the order of the run's episodes.

    suite: the run's, for `pixels`. Raises UsageError for an unknown name or a missing column.
    """
    if name == "position":
        return _layout(run.episodes)
    if name == "instruction":
        return _words(run)
    if name == "pixels":
        assert suite is not None, "what needs pictures is given them"
        return tile_pixels(run.episodes, suite, THUMBNAIL)
    raise UsageError(f"unknown control {name!r}; expected one of {', '.join(BASELINES)}")


def _layout(episodes: "pd.DataFrame") -> Features:
    """(E, 1): +1 in the original layout, −1 in the swapped one."""
    original = (episodes["layout"] == "original").to_numpy()
    return np.where(original, np.float32(1), np.float32(-1))[:, None]


def _words(run: RunReader) -> Features:
    """(E, 2 W): how often each word occurs in the instruction, then the same times the layout's sign.

    The second half shows a word whose picture always lies on one side.
    """
    counts = word_counts(run)
    return np.hstack([counts, counts * _layout(run.episodes)])


def word_counts(run: RunReader) -> Features:
    """(E, W): how often each word occurs in the instruction. Raises UsageError without instructions."""
    if "instruction" not in run.episodes:
        raise UsageError(f"the episodes of {run.location} have no column 'instruction'; leave that control out")
    words = [str(text).lower().split() for text in run.episodes["instruction"]]
    known = {word: number for number, word in enumerate(sorted({word for text in words for word in text}))}
    counts = np.zeros((len(words), len(known)), np.float32)
    for row, text in enumerate(words):
        for word in text:
            counts[row, known[word]] += 1
    return counts


def tile_pixels(episodes: "pd.DataFrame", suite: "Suite", side: int) -> Features:
    """(E, 6 side²): the left and the right picture of every episode, RGB from 0 to 1, `side` pixels wide."""
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
