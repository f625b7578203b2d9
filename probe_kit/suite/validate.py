"""The check of a suite (`validate_suite`): all rules, W01 to W09 and, on request, the leakage checks.

Leakage: can pictures alone, text alone or a fixed side identify the correct picture? Each baseline predicts the
correct side of every episode (both layouts of every item), trained on other groups. Chance is one half. A category
passes if no baseline is further above chance than the interval of a coin over that many *items*. The two layouts
of an item are not independent.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from probe_kit._system.counting import plural
from probe_kit._system.drafts import write_whole
from probe_kit._system.types import Matrix
from probe_kit.hashing import derive_seed
from probe_kit.statistics.folds import OUTER_FOLDS, assign_folds
from probe_kit.statistics.intervals import Accuracy
from probe_kit.statistics.significance import chance_margin
from probe_kit.suite.categories import CATEGORIES, OWN_DOMAIN, category_of
from probe_kit.suite.items import Episode, Item, counterparts_of
from probe_kit.suite.manifest import read_suite
from probe_kit.suite.pictures import NEAR_DUPLICATE_BITS, Look, load_picture, look_of
from probe_kit.suite.rules import DECODING_RULES, SIDES, Finding, listing, warning
from probe_kit.suite.suite import Suite, count_by_category, missing_categories

LEAST_ROLE_BALANCE = 0.4
FEWEST_ITEMS = 30
SCREEN_PIXELS = 40  # a tile's side on a 224 px frame, see docs/suite.md

_FEWEST_USES = 5  # with fewer, balance cannot be judged
_INK_STEP = 32  # levels that a pixel differs from the border of its picture
_LEAST_EXTENT = 0.2  # of the tile, along the longer side of the ink's box
_LEAST_INK = 0.02
_LEAST_SPREAD = 8.0  # standard deviation of the grey levels


def sides_balanced(suite: Suite) -> Iterator[Finding]:
    """Check W01: per category, as many answers lie left as right in the original layout."""
    for category, sides in side_counts(suite.items).items():
        if abs(sides["left"] - sides["right"]) > 1:
            yield warning("W01", category_of(category).title, f"{sides['left']} left / {sides['right']} right")


def side_counts(items: Sequence[Item]) -> dict[str, Counter[str]]:
    """Return by category how often the answer lies on each side of the original layout."""
    counts: dict[str, Counter[str]] = {category: Counter() for category in count_by_category(items)}
    for item in items:
        counts[item.category][item.correct_side] += 1
    return counts


def roles_balanced(suite: Suite) -> Iterator[Finding]:
    """Check W02: every concept that occurs a few times is target about as often as distractor."""
    for (category, concept), (target, distractor) in role_counts(suite.items).items():
        uses = target + distractor
        if uses >= _FEWEST_USES and min(target, distractor) / uses < LEAST_ROLE_BALANCE:
            message = f"concept {concept!r} is target {target}×, distractor {distractor}×"
            yield warning("W02", category_of(category).title, message)


def role_counts(items: Sequence[Item]) -> dict[tuple[str, str], tuple[int, int]]:
    """Return by category and concept how often it is the target and how often the distractor.

    Where an item has a counterpart, the concept of its wrong picture is the one that the counterpart asks for. A
    table of one's own names the correct picture alone.
    """
    twins = counterparts_of(items)
    targets = Counter((item.category, item.target_concept) for item in items)
    distractors = Counter((item.category, _distractor(item, twins.get(item.item_id))) for item in items)
    return {key: (targets[key], distractors[key]) for key in sorted(targets | distractors)}


def _distractor(item: Item, twin: Item | None) -> str:
    if twin is None or twin.target_concept == item.target_concept:
        return item.distractor_concept
    return twin.target_concept


def pictures_distinct(suite: Suite) -> Iterator[Finding]:
    """Check W03: no two pictures of different groups look nearly the same.

    Procedural items are left out: two drawings of one sign or one clock always look alike.
    """
    pictures: dict[Path, Item] = {}
    for item in suite.items:
        if item.construction != "procedural":
            for side in SIDES:
                if item.picture(side).is_file():
                    pictures.setdefault(item.picture(side), item)
    items = list(pictures.values())
    for first, second in _near_duplicates([look_of(load_picture(path)) for path in pictures]):
        if items[first].group_id != items[second].group_id:
            names = f"items {items[first].item_id} and {items[second].item_id}"
            yield warning(
                "W03",
                names,
                "show nearly the same picture but are in different groups; give them one group, or other pictures",
            )


def _near_duplicates(looks: Sequence[Look]) -> Iterator[tuple[int, int]]:
    hashes = np.array([look.brightness for look in looks], np.uint64)
    for first in range(len(looks)):
        distances = np.bitwise_count(hashes[first + 1 :] ^ hashes[first])
        for second in first + 1 + np.flatnonzero(distances <= NEAR_DUPLICATE_BITS):
            if looks[first].same_as(looks[second]):
                yield first, int(second)


def enough_items(suite: Suite) -> Iterator[Finding]:
    """Check W04: there are at least 30 items per category, and as many as were requested."""
    option = suite.card.get("options", {}).get("items_per_category")
    for category, count in count_by_category(suite.items).items():
        requested = option.get(category) if isinstance(option, dict) else option
        if requested is not None and count != requested:
            yield warning("W04", category_of(category).title, f"{count} of {requested} requested")
        elif count < FEWEST_ITEMS:
            yield warning(
                "W04", category_of(category).title, f"{plural(count, 'item')}; fewer than {FEWEST_ITEMS}"
            )


def enough_groups(suite: Suite) -> Iterator[Finding]:
    """Check W09: every category has enough independent groups to train probes on some and test them on others."""
    groups: dict[str, set[str]] = {category: set() for category in suite.categories}
    for item in suite.items:
        groups[item.category].add(item.group_id)
    for category, members in groups.items():
        if len(members) < OUTER_FOLDS:
            message = f"{plural(len(members), 'independent group')}; probes need at least {OUTER_FOLDS}"
            yield warning("W09", category_of(category).title, message)


def legible(suite: Suite) -> Iterator[Finding]:
    """Check W06: at a tile's size on the screen, something large enough stands out from the picture's border."""
    checked = set()
    for item in suite.items:
        for side in SIDES:
            path = item.picture(side)
            if path not in checked and path.is_file():
                checked.add(path)
                problem = _illegible(load_picture(path))
                if problem:
                    yield warning("W06", f"item {item.item_id}", f"{side} picture {problem}")


def _illegible(image: Image.Image) -> str | None:
    small = image.resize((SCREEN_PIXELS, SCREEN_PIXELS), Image.Resampling.LANCZOS)
    pixels = np.asarray(small, np.float64)
    if pixels.mean(axis=2).std() < _LEAST_SPREAD and pixels.std(axis=(0, 1)).max() < _LEAST_SPREAD:
        return "has little contrast"
    border = np.median(np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]]), axis=0)
    rows, columns = np.nonzero(np.abs(pixels - border).max(axis=2) > _INK_STEP)
    if len(rows) < _LEAST_INK * SCREEN_PIXELS**2:
        return "shows almost nothing"
    extent = max(np.ptp(rows), np.ptp(columns)) + 1
    if extent < _LEAST_EXTENT * SCREEN_PIXELS:
        return f"shows something only {extent} px large at {SCREEN_PIXELS} px"
    return None


def side_word_signs(suite: Suite) -> Iterator[Finding]:
    """Report W07: signs with a side word in their name, which E10 lets pass."""
    marked = sorted((item for item in suite.items if item.side_word), key=attrgetter("category", "object_phrase"))
    for (category, phrase), items in groupby(marked, key=attrgetter("category", "object_phrase")):
        message = (
            f"{phrase!r} names a side in {len(list(items))} items; a model asked for left or right may stumble"
        )
        yield warning("W07", category_of(category).title, message)


def categories_meant(suite: Suite) -> Iterator[Finding]:
    """Check W08: a category of one's own is not one of the paper's misspelt.

    It is checked only next to categories of the paper: in a suite of one's own questions alone, categories may
    have any name.
    """
    if all(category_of(slug).domain == OWN_DOMAIN for slug in suite.categories):
        return
    for slug in suite.categories:
        near = get_close_matches(slug, CATEGORIES, n=1, cutoff=0.8)
        if category_of(slug).domain == OWN_DOMAIN and near:
            yield warning("W08", slug, f"is none of the paper; if {near[0]!r} is meant, rename it")


WARNING_RULES: Sequence[Callable[[Suite], Iterator[Finding]]] = (
    sides_balanced,
    roles_balanced,
    pictures_distinct,
    enough_items,
    enough_groups,
    legible,
    side_word_signs,
    categories_meant,
)


# -- leakage -----------------------------------------------------------------------------------------------------


FILE_NAME = "baselines.json"
FOLDS = 5

_THUMBNAIL = 32
_TREES = 60
_WORD_BUCKETS = 256
_INK_SUM_STEP = 60

Labels = npt.NDArray[np.bool_]  # True where the correct picture lies left
Rows = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Baseline:
    """The accuracy of one baseline on the correct side in one category.

    Attributes:
        interval: Low and high of the 95 % interval, groups as the unit.
        limit: Largest accuracy with which the category passes.
        grouping: Column of the groups that folds kept together, `group_id` or `pair_id`.
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
    """Return 0.5 plus the half width of a coin's 95 % interval over that many items."""
    return 0.5 + chance_margin(items)


def run_baselines(
    suite: Suite, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> tuple[Baseline, ...]:
    """Run every baseline on every category that has at least two groups or pairs to learn from."""
    results: list[Baseline] = []
    for number, category in enumerate(suite.categories, start=1):
        results += _category_baselines(suite.select([category]), category, seed)
        if progress:
            progress(number, len(suite.categories))
    return tuple(results)


def save_baselines(suite: Suite, baselines: Sequence[Baseline]) -> Path:
    """Write `baselines.json` to the suite's folder, with the balance of sides and roles.

    The file is no part of the suite's hash.
    """
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
        interval = Accuracy.of(hits, groups).interval()
        yield Baseline(
            category=category,
            name=name,
            accuracy=round(float(hits.mean()), 4),
            interval=(round(interval.low, 4), round(interval.high, 4)),
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


# -- features ----------------------------------------------------------------------------------------


def _both_sides(episodes: Sequence[Episode], describe: Callable[[Image.Image], Matrix]) -> Matrix:
    """Return the values of `describe` for the left and then the right picture of every episode."""
    paths = {episode.picture(side) for episode in episodes for side in SIDES}
    described = {path: describe(load_picture(path)) for path in paths}
    return np.array([np.concatenate([described[episode.picture(side)] for side in SIDES]) for episode in episodes])


def _pixels(episodes: Sequence[Episode]) -> Matrix:
    def describe(image: Image.Image) -> Matrix:
        small = image.resize((_THUMBNAIL, _THUMBNAIL), Image.Resampling.BOX)
        return np.asarray(small, np.float64).ravel() / 255

    return _both_sides(episodes, describe)


def _statistics(episodes: Sequence[Episode]) -> Matrix:
    """Return the features that need no recognition: colour, spread, background, ink, edges, extent."""

    def describe(image: Image.Image) -> Matrix:
        pixels = np.asarray(image.resize((64, 64), Image.Resampling.BOX), np.float64)
        background = np.median(np.concatenate([pixels[0], pixels[-1]]), axis=0)
        ink = np.abs(pixels - background).sum(axis=2) > _INK_SUM_STEP
        grey = pixels.mean(axis=2)
        edges = [np.abs(np.diff(grey, axis=axis)).mean() for axis in (0, 1)]
        extent = [ink.any(axis=axis).mean() for axis in (0, 1)]
        spread = pixels.std(axis=(0, 1))
        return np.concatenate([pixels.mean(axis=(0, 1)), spread, background, [ink.mean()], edges, extent])

    return _both_sides(episodes, describe)


def _words(episodes: Sequence[Episode]) -> Matrix:
    """Return the hashed bag of the instruction's words."""
    counts = np.zeros((len(episodes), _WORD_BUCKETS))
    for row, episode in enumerate(episodes):
        for word in episode.item.instruction.lower().split():
            counts[row, derive_seed("word", word) % _WORD_BUCKETS] += 1
    return counts


# -- learners ----------------------------------------------------------------------------------------


def _linear(features: Matrix, correct: Labels, train: Rows, test: Rows) -> Labels:
    from sklearn.linear_model import RidgeClassifier
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    model = make_pipeline(StandardScaler(), RidgeClassifier(alpha=features.shape[1]))
    return np.asarray(model.fit(features[train], correct[train]).predict(features[test]), bool)


def _forest(features: Matrix, correct: Labels, train: Rows, test: Rows, seed: int) -> Labels:
    from sklearn.ensemble import RandomForestClassifier

    model = RandomForestClassifier(_TREES, random_state=seed)
    return np.asarray(model.fit(features[train], correct[train]).predict(features[test]), bool)


# -- the report --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Report:
    """The findings on a suite: violated rules, warnings, and baselines.

    Attributes:
        suite: Identity of the suite, or its folder if the card cannot be read.
        missing: Names of the paper's categories without items.
        baselines: Results of the baselines; None if they were not run.
    """

    suite: str
    missing: tuple[str, ...]
    findings: tuple[Finding, ...]
    baselines: tuple[Baseline, ...] | None = None

    @property
    def errors(self) -> tuple[Finding, ...]:
        """The findings that make the suite unusable."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """All other findings."""
        return tuple(finding for finding in self.findings if finding.severity == "warning")

    @property
    def ok(self) -> bool:
        """Whether the suite is valid and, where baselines were run, no answer leaks."""
        return not self.errors and all(baseline.ok for baseline in self.baselines or ())

    def to_json(self) -> dict[str, Any]:
        """Return the report as plain values, every finding included."""
        baselines = None if self.baselines is None else [asdict(b) | {"ok": b.ok} for b in self.baselines]
        return {
            "suite": self.suite,
            "ok": self.ok,
            "missing": list(self.missing),
            "findings": [asdict(finding) for finding in self.findings],
            "baselines": baselines,
        }

    def to_text(self) -> str:
        """Return the text for a terminal: at most 20 findings of each rule, the baselines, the verdict."""
        lines = [listing(self.errors), listing(self.warnings)]
        lines += [f"{category_of(baseline.category).title}: {baseline}" for baseline in self.baselines or ()]
        # A few questions of one's own that happen to be of a category of the paper do not claim to be its set.
        if 0 < len(self.missing) <= len(CATEGORIES) // 2:
            lines.append(f"Not in this suite: {', '.join(category_of(slug).title for slug in self.missing)}.")
        verdict = "valid" if self.ok else "not valid"
        counts = f"{plural(len(self.errors), 'error')}, {plural(len(self.warnings), 'warning')}"
        lines.append(f"{self.suite}: {verdict}, {counts}")
        return "\n".join(line for line in lines if line)


def validate_suite(
    folder: Path | str,
    baselines: bool = False,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """Check the suite in `folder` and return a report.

    Args:
        folder: Folder of the suite.
        baselines: Whether to run the leakage checks too and store them in the suite's `baselines.json`; not done
            for a suite with errors.
        seed: Seed of the baselines' folds and trees.
        progress: Function that is called with the number of categories done and of all categories; None for no
            reports.

    Raises:
        UsageError: If there is no suite.
    """
    folder = Path(folder).absolute()
    suite, findings = read_suite(folder)
    if suite is None:
        return Report(str(folder), (), tuple(findings))
    findings += [finding for rule in DECODING_RULES for finding in rule(suite)]
    undecodable = any(finding.rule in ("E05", "E07") for finding in findings)
    if not undecodable:
        findings += [finding for rule in WARNING_RULES for finding in rule(suite)]
    gates = None
    if baselines and not any(finding.severity == "error" for finding in findings):
        gates = run_baselines(suite, seed, progress)
        save_baselines(suite, gates)
        findings += [
            warning("W05", category_of(gate.category).title, f"{gate}. {_REMEDIES[gate.name]}")
            for gate in gates
            if not gate.ok
        ]
    once = tuple(dict.fromkeys(findings))  # two pictures of two items can give one line twice
    return Report(suite.identity, tuple(missing_categories(suite.items)), once, gates)


_BOTH_WAYS = (
    "The answer shows without understanding the question. Ask each pair of pictures both ways, so that "
    "every picture is as often right as wrong"
)
_REMEDIES = {
    "position": "The answer lies on one side. Let it lie left as often as right",
    "instruction": _BOTH_WAYS,
    "pixels": _BOTH_WAYS,
    "statistics": _BOTH_WAYS,
}
