"""Leakage checks: can pictures alone, text alone or a fixed side identify the correct picture?

Each baseline predicts the correct side of every episode (both layouts of every item), trained on other groups.
Chance is one half. A category passes if no baseline is further above chance than the interval that a coin has over
that many *items*: the two layouts of an item are not independent.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from probe_kit._system.drafts import write_whole
from probe_kit.hashing import derive_seed
from probe_kit.statistics.estimates.shares import Accuracy
from probe_kit.statistics.folds import assign_folds
from probe_kit.statistics.significance import chance_margin
from probe_kit.suite.items import Episode, Side
from probe_kit.suite.pictures import load_picture
from probe_kit.suite.suite import Suite
from probe_kit.suite.validation.warnings import role_counts, side_counts

FILE_NAME = "baselines.json"
FOLDS = 5

_THUMBNAIL = 32
_TREES = 60
_WORD_BUCKETS = 256
_INK_STEP = 60
_SIDES: tuple[Side, Side] = ("left", "right")

Array = npt.NDArray[np.float64]
Labels = npt.NDArray[np.bool_]  # True where the correct picture lies left
Rows = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Baseline:
    """The accuracy of one baseline on the correct side in one category.

    interval: 95 %, from resampling groups. limit: what it may not exceed. grouping: what folds kept together.
    """

    category: str
    name: str
    accuracy: float
    interval: tuple[float, float]
    limit: float
    items: int
    groups: int
    grouping: str
    chance: float = 0.5

    @property
    def ok(self) -> bool:
        """Whether it is within the limit."""
        return self.accuracy <= self.limit

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.name} {self.accuracy:.2f} [{low:.2f}, {high:.2f}] (limit {self.limit:.2f})"


def limit_for(items: int) -> float:
    """0.5 plus the half width of a coin's 95 % interval over that many items."""
    return 0.5 + chance_margin(items)


def run_baselines(
    suite: Suite, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> tuple[Baseline, ...]:
    """Every baseline on every category of the suite that has at least two groups or pairs to learn from."""
    results: list[Baseline] = []
    for number, category in enumerate(suite.categories, start=1):
        results += _category_baselines(suite.select([category]), category, seed)
        if progress:
            progress(number, len(suite.categories))
    return tuple(results)


def save_baselines(suite: Suite, baselines: Sequence[Baseline]) -> Path:
    """`baselines.json` in the suite's folder, with the balance of sides and roles; no part of the suite's hash."""
    path = suite.folder / FILE_NAME
    roles: dict[str, dict[str, dict[str, int]]] = {}
    for (category, concept), (target, distractor) in role_counts(suite.items).items():
        roles.setdefault(category, {})[concept] = {"target": target, "distractor": distractor}
    content = {
        "suite": suite.identity,
        "baselines": [asdict(baseline) | {"ok": baseline.ok} for baseline in baselines],
        "sides": {category: dict(sides) for category, sides in side_counts(suite.items).items()},
        "roles": roles,
    }
    write_whole(path, json.dumps(content, indent=1, sort_keys=True, ensure_ascii=False) + "\n")
    return path


def _category_baselines(suite: Suite, category: str, seed: int) -> Iterator[Baseline]:
    episodes = suite.episodes()
    groups, grouping = _groups(episodes)
    names = np.unique(groups)
    if len(names) < 2:
        return
    correct = np.array([episode.side_correct == "left" for episode in episodes])
    folds = assign_folds(correct, groups, min(FOLDS, len(names)), derive_seed("folds", seed))
    words, pixels, statistics = _words(episodes), _pixels(episodes), _statistics(episodes)
    predictors: dict[str, Callable[[Rows, Rows], Labels]] = {
        "position": lambda train, test: np.full(len(test), correct[train].mean() >= 0.5),
        "instruction": lambda train, test: _linear(words, correct, train, test),
        "pixels": lambda train, test: _linear(pixels, correct, train, test),
        "statistics": lambda train, test: _forest(statistics, correct, train, test, seed),
    }
    for name, predict in predictors.items():
        hits = np.zeros(len(episodes))
        for fold in range(int(folds.max()) + 1):
            train, test = np.flatnonzero(folds != fold), np.flatnonzero(folds == fold)
            hits[test] = predict(train, test) == correct[test]
        yield Baseline(
            category=category,
            name=name,
            accuracy=round(float(hits.mean()), 4),
            interval=_interval(hits, groups),
            limit=round(limit_for(len(suite.items)), 4),
            items=len(suite.items),
            groups=len(names),
            grouping=grouping,
        )


def _groups(episodes: Sequence[Episode]) -> tuple[npt.NDArray[np.str_], str]:
    """Return the groups that a fold must not separate: connected pictures, or twins where all are connected."""
    groups = np.array([episode.item.group_id for episode in episodes])
    if len(np.unique(groups)) >= FOLDS:
        return groups, "group_id"
    return np.array([episode.item.pair_id for episode in episodes]), "pair_id"


def _interval(hits: Array, groups: npt.NDArray[np.str_]) -> tuple[float, float]:
    """95 % interval of an accuracy, groups as the unit."""
    interval = Accuracy.of(hits, groups).interval()
    return round(interval.low, 4), round(interval.high, 4)


# -- features ----------------------------------------------------------------------------------------


def _both_sides(episodes: Sequence[Episode], describe: Callable[[Image.Image], Array]) -> Array:
    """Return the values of `describe` for the left and then the right picture of every episode."""
    paths = {episode.picture(side) for episode in episodes for side in _SIDES}
    described = {path: describe(load_picture(path)) for path in paths}
    return np.array(
        [np.concatenate([described[episode.picture(side)] for side in _SIDES]) for episode in episodes]
    )


def _pixels(episodes: Sequence[Episode]) -> Array:
    def describe(image: Image.Image) -> Array:
        small = image.resize((_THUMBNAIL, _THUMBNAIL), Image.Resampling.BOX)
        return np.asarray(small, np.float64).ravel() / 255

    return _both_sides(episodes, describe)


def _statistics(episodes: Sequence[Episode]) -> Array:
    """Return the features that need no recognition: colour, spread, background, ink, edges, extent."""

    def describe(image: Image.Image) -> Array:
        pixels = np.asarray(image.resize((64, 64), Image.Resampling.BOX), np.float64)
        background = np.median(np.concatenate([pixels[0], pixels[-1]]), axis=0)
        ink = np.abs(pixels - background).sum(axis=2) > _INK_STEP
        grey = pixels.mean(axis=2)
        edges = [np.abs(np.diff(grey, axis=axis)).mean() for axis in (0, 1)]
        extent = [ink.any(axis=axis).mean() for axis in (0, 1)]
        spread = pixels.std(axis=(0, 1))
        return np.concatenate([pixels.mean(axis=(0, 1)), spread, background, [ink.mean()], edges, extent])

    return _both_sides(episodes, describe)


def _words(episodes: Sequence[Episode]) -> Array:
    """Hashed bag of the instruction's words."""
    counts = np.zeros((len(episodes), _WORD_BUCKETS))
    for row, episode in enumerate(episodes):
        for word in episode.item.instruction.lower().split():
            counts[row, derive_seed("word", word) % _WORD_BUCKETS] += 1
    return counts


# -- learners ----------------------------------------------------------------------------------------


def _linear(features: Array, correct: Labels, train: Rows, test: Rows) -> Labels:
    from sklearn.linear_model import RidgeClassifier
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    model = make_pipeline(StandardScaler(), RidgeClassifier(alpha=features.shape[1]))
    return np.asarray(model.fit(features[train], correct[train]).predict(features[test]), bool)


def _forest(features: Array, correct: Labels, train: Rows, test: Rows, seed: int) -> Labels:
    from sklearn.ensemble import RandomForestClassifier

    model = RandomForestClassifier(_TREES, random_state=seed)
    return np.asarray(model.fit(features[train], correct[train]).predict(features[test]), bool)
