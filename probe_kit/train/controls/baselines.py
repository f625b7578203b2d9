"""Features that never saw the model: what layout, instruction and pictures alone give away."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import SuiteError, UsageError
from probe_kit.train.data.run_reader import RunReader

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.suite import Suite

Baseline = Literal["position", "instruction", "pixels", "binding"]
BASELINES: dict[str, str] = {
    "position": "the layout alone",
    "instruction": "the words of the instruction, alone and with the layout",
    "pixels": "the two pictures, left and right, at 32 × 32 pixels; needs the suite",
    "binding": "random nonlinear features of pictures and words together, as wide as the site; needs the suite",
}
THUMBNAIL = 32

Features = NDArray[np.float32]


def baseline_features(run: RunReader, name: Baseline, suite: Path | None) -> Features:
    """(E, D) features of a baseline but `binding`, rows in the order of the run's episodes.

    Raises UsageError for an unknown name, a missing column or a missing suite, SuiteError for another suite.
    """
    if name == "position":
        return _layout(run.episodes)
    if name == "instruction":
        return _words(run)
    if name == "pixels":
        return tile_pixels(run.episodes, suite_of(run, needed(suite, name)), THUMBNAIL)
    raise UsageError(f"unknown control {name!r}; expected one of {', '.join(BASELINES)}")


def needed(suite: Path | None, name: Baseline) -> Path:
    """`suite`, for a baseline that needs it. Raises UsageError without one."""
    if suite is None:
        raise UsageError(f"the control {name!r} needs the pictures: give the folder of the run's suite as `suite`")
    return suite


def suite_of(run: RunReader, folder: Path) -> "Suite":
    """The suite in `folder`, if it is the run's, or holds the run's items as part of it.

    Raises SuiteError if neither hash is the one the run was extracted with.
    """
    from probe_kit.suite import load_suite
    from probe_kit.suite.suite import content_sha256

    suite, ids = load_suite(folder), set(run.episodes["item_id"])
    expected = run.suite.rpartition("#")[2]
    part = content_sha256(item for item in suite.items if item.item_id in ids)
    if not (suite.content_sha256.startswith(expected) or part.startswith(expected)):
        raise SuiteError(
            f"{folder} holds {suite.identity}, and its items that {run.location} has hash to {part[:12]}; the run "
            f"was extracted from {run.suite}. Give that suite's folder, and a run with all its episodes."
        )
    return suite


def embedded_suite_of(run: RunReader) -> Path | None:
    """Folder of the embedded suite, if it was built here and the run's pictures come from it."""
    from probe_kit.suite.build import default_folder
    from probe_kit.suite.generators.couples import SUITE_NAME

    folder = default_folder()
    if not run.suite.startswith(f"{SUITE_NAME}@") or not folder.is_dir():
        return None
    try:
        suite_of(run, folder)
    except SuiteError:  # drawn with another seed or version
        return None
    return folder


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
