"""Phrases of a question: the correct object, the other one, or one that neither picture shows.

Phrases come from the items themselves, never out of an instruction.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.suite import Item, Suite

Query = Literal["target", "distractor", "absent"]
Picture = Literal["frame", "side-by-side", "none"]
"""What a question shows: the first frame, the two pictures on grey, or nothing."""
QUERIES: Mapping[Query, str] = {
    "target": "the object of the instruction",
    "distractor": "the other picture's: right is the other side",
    "absent": "an object that neither picture shows: right is no",
}
_MOST_NAMED = 3


@dataclass(frozen=True)
class Phrase:
    """The words for an object. article: "the", or empty for a name that has none."""

    text: str
    article: str

    @classmethod
    def of(cls, item: Item) -> "Phrase":
        """The object of an item's instruction."""
        return cls(item.object_phrase, "the" if item.object_article == "the" else "")

    @property
    def with_article(self) -> str:
        """The phrase as it stands in a sentence."""
        return f"{self.article} {self.text}".strip()


def phrases(suite: Suite, query: Query, seed: int = 0) -> dict[str, Phrase]:
    """Return the phrase that is asked for by item; the same in both layouts, and the same for the same seed.

    Other objects are those of the whole suite, so that a phrase does not depend on the number of items asked for.
    Raises UsageError naming the first items for which the suite has no such phrase.
    """
    if query == "target":
        return {item.item_id: Phrase.of(item) for item in suite.items}
    by_category: dict[str, list[Item]] = {}
    for item in suite.complete.items:
        by_category.setdefault(item.category, []).append(item)
    choose = _distractor if query == "distractor" else _absent
    by_item = {item.item_id: choose(item, by_category[item.category], seed) for item in suite.items}
    missing = [item for item in suite.items if by_item[item.item_id] is None]
    if missing:
        categories = ", ".join(sorted({item.category for item in missing}))
        some = ", ".join(item.item_id for item in missing[:_MOST_NAMED])
        raise UsageError(
            f"--query {query}: {len(missing)} of {len(suite.items)} items, in {categories}, have no phrase for it "
            f"({some} …): {_WHY[query]}. Choose other --categories"
        )
    return {name: phrase for name, phrase in by_item.items() if phrase is not None}


_WHY: Mapping[Query, str] = {
    "distractor": "no item of the category names what their other picture shows",
    "absent": "every object of the category is named by one of their pictures, or may be seen on it",
}


def _distractor(item: Item, items: Sequence[Item], _seed: int) -> Phrase | None:
    """The phrase of the item that asks for the other picture: the role-exchanged twin, or any other."""
    naming = [other for other in items if other.target_concept == item.distractor_concept]
    twins = [other for other in naming if other.group_id == item.group_id]
    if twins or naming:
        return Phrase.of((twins or naming)[0])
    if item.object_phrase.count(item.target_concept) == 1:
        phrase = Phrase.of(item)
        return Phrase(phrase.text.replace(item.target_concept, item.distractor_concept), phrase.article)
    return None


def _absent(item: Item, items: Sequence[Item], seed: int) -> Phrase | None:
    """A phrase of the category whose concept is in neither picture.

    Comparisons, such as "less smiling person", hold of some picture of every pair of their kind: where a category
    has both kinds, an item gets a phrase of its own kind only.
    """
    concepts = {item.target_concept, item.distractor_concept}
    compares = item.polarity != "none"
    absent = {
        Phrase.of(other)
        for other in items
        if not concepts & {other.target_concept} and (other.polarity != "none") == compares
    }
    text = Phrase.of(item).text
    listed = sorted((phrase.text, phrase.article) for phrase in absent if phrase.text != text)
    if not listed:
        return None
    return Phrase(*listed[derive_seed(seed, "absent", item.item_id) % len(listed)])
