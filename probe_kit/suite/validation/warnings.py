"""W01 to W04 and W06 to W09: properties of a suite that can bias its numbers."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from difflib import get_close_matches
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import numpy as np
from PIL import Image

from probe_kit._system.counting import counted
from probe_kit.statistics.folds import OUTER_FOLDS
from probe_kit.suite.categories import CATEGORIES, OWN_DOMAIN, category_of
from probe_kit.suite.grouping import counterparts_of
from probe_kit.suite.items import Item
from probe_kit.suite.pictures import NEAR_DUPLICATE_BITS, Look, load_picture, look_of
from probe_kit.suite.suite import Suite, count_by_category
from probe_kit.suite.validation.records import Finding, warning
from probe_kit.suite.validation.rules import SIDES

LEAST_ROLE_BALANCE = 0.4
FEWEST_ITEMS = 30
SCREEN_PIXELS = 40  # a tile's side on a 224 px frame, see docs/suite.md

_FEWEST_USES = 5  # with fewer, balance cannot be judged
_INK_STEP = 32  # levels that a pixel differs from the border of its picture
_LEAST_EXTENT = 0.2  # of the tile, along the longer side of the ink's box
_LEAST_INK = 0.02
_LEAST_SPREAD = 8.0  # standard deviation of the grey levels


def sides_balanced(suite: Suite) -> Iterator[Finding]:
    """W01: per category, as many answers lie left as right in the original layout."""
    for category, sides in side_counts(suite.items).items():
        if abs(sides["left"] - sides["right"]) > 1:
            yield warning("W01", category_of(category).title, f"{sides['left']} left / {sides['right']} right")


def side_counts(items: Sequence[Item]) -> dict[str, Counter[str]]:
    """Per category, how often the answer lies on each side of the original layout."""
    counts: dict[str, Counter[str]] = {category: Counter() for category in count_by_category(items)}
    for item in items:
        counts[item.category][item.correct_side] += 1
    return counts


def roles_balanced(suite: Suite) -> Iterator[Finding]:
    """W02: every concept that occurs a few times is target about as often as distractor."""
    for (category, concept), (target, distractor) in role_counts(suite.items).items():
        uses = target + distractor
        if uses >= _FEWEST_USES and min(target, distractor) / uses < LEAST_ROLE_BALANCE:
            message = f"concept {concept!r} is target {target}×, distractor {distractor}×"
            yield warning("W02", category_of(category).title, message)


def role_counts(items: Sequence[Item]) -> dict[tuple[str, str], tuple[int, int]]:
    """Per category and concept, how often it is the target and how often the distractor.

    What the wrong picture shows is what its counterpart asks for, where there is one: a table of one's own names
    the correct picture alone.
    """
    twins = counterparts_of(items)
    targets = Counter((item.category, item.target_concept) for item in items)
    distractors = Counter((item.category, _distractor(item, twins.get(item.item_id))) for item in items)
    return {key: (targets[key], distractors[key]) for key in sorted(targets | distractors)}


def _distractor(item: Item, twin: Item | None) -> str:
    """The concept of an item's wrong picture."""
    if twin is None or twin.target_concept == item.target_concept:
        return item.distractor_concept
    return twin.target_concept


def pictures_distinct(suite: Suite) -> Iterator[Finding]:
    """W03: no two pictures of different groups look nearly the same.

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
    """W04: at least 30 items per category, and as many as were asked for."""
    option = suite.card.get("options", {}).get("items_per_category")
    for category, count in count_by_category(suite.items).items():
        requested = option.get(category) if isinstance(option, dict) else option
        if requested is not None and count != requested:
            yield warning("W04", category_of(category).title, f"{count} of {requested} requested")
        elif count < FEWEST_ITEMS:
            yield warning(
                "W04", category_of(category).title, f"{counted(count, 'item')}; fewer than {FEWEST_ITEMS}"
            )


def enough_groups(suite: Suite) -> Iterator[Finding]:
    """W09: enough independent groups per category for probes to be trained on some and tested on others."""
    groups: dict[str, set[str]] = {category: set() for category in suite.categories}
    for item in suite.items:
        groups[item.category].add(item.group_id)
    for category, members in groups.items():
        if len(members) < OUTER_FOLDS:
            message = f"{counted(len(members), 'independent group')}; probes need at least {OUTER_FOLDS}"
            yield warning("W09", category_of(category).title, message)


def legible(suite: Suite) -> Iterator[Finding]:
    """W06: at the size a tile has on the screen, something large enough stands out from the picture's border."""
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
    """W07: signs with a side word in their name, which E10 lets pass."""
    marked = sorted((item for item in suite.items if item.side_word), key=attrgetter("category", "object_phrase"))
    for (category, phrase), items in groupby(marked, key=attrgetter("category", "object_phrase")):
        message = (
            f"{phrase!r} names a side in {len(list(items))} items; a model asked for left or right may stumble"
        )
        yield warning("W07", category_of(category).title, message)


def categories_meant(suite: Suite) -> Iterator[Finding]:
    """W08: a category of one's own is not one of the paper's misspelt.

    Beside categories of the paper alone: questions of one's own may be called as they like.
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
