"""Questions in words to a model: phrases of objects, prompt templates, and pictures side by side.

Places in a template: `the {object}` is the object with its article, if it has one, `{object}` without. `{A}` and
`{B}` are the words for the two sides, in either order. A letter A in front of `{A}` and a letter B in front of
`{B}` make them options that are answered by their letter. Without letters they are answered in words. A template
with `{instruction}` shows a VLM the words of the policies, to compare activations with theirs.

Phrases come from the items themselves, never out of an instruction.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._system.bounded_files import read_regular_text
from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed, sha256_text
from probe_kit.suite import Episode, Item, Side, Suite, load_picture
from probe_kit.suite.items import other_side

Query = Literal["target", "distractor", "absent"]
PictureShown = Literal["frame", "side-by-side", "none"]
"""The picture of a question: the first frame, the two pictures on grey, or nothing."""
QUERIES: Mapping[Query, str] = {
    "target": "the object of the instruction",
    "distractor": "the other picture's: right is the other side",
    "absent": "an object that neither picture shows: right is no",
}
_MOST_NAMED = 3


@dataclass(frozen=True)
class Phrase:
    """The words for an object.

    Attributes:
        text: The words without an article.
        article: The article "the", or empty for a name that has none.
    """

    text: str
    article: str

    @classmethod
    def of(cls, item: Item) -> "Phrase":
        """Return the object of an item's instruction."""
        return cls(item.object_phrase, "the" if item.object_article == "the" else "")

    @property
    def with_article(self) -> str:
        """The phrase as it is written in a sentence."""
        return f"{self.article} {self.text}".strip()


def phrases(suite: Suite, query: Query, seed: int = 0) -> dict[str, Phrase]:
    """Return by item the phrase that is asked for; the same in both layouts, and the same for the same seed.

    Other objects are those of the whole suite, so that a phrase does not depend on the number of items asked for.

    Raises:
        UsageError: Naming the first items for which the suite has no such phrase.
    """
    if query == "target":
        return {item.item_id: Phrase.of(item) for item in suite.items}
    by_category: dict[str, list[Item]] = {}
    for item in suite.complete.items:
        by_category.setdefault(item.category, []).append(item)
    choose = _distractor if query == "distractor" else _absent_phrase
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
    """Return the phrase of the item that asks for the other picture: the role-exchanged twin, or any other."""
    naming = [other for other in items if other.target_concept == item.distractor_concept]
    twins = [other for other in naming if other.group_id == item.group_id]
    if twins or naming:
        return Phrase.of((twins or naming)[0])
    if item.object_phrase.count(item.target_concept) == 1:
        phrase = Phrase.of(item)
        return Phrase(phrase.text.replace(item.target_concept, item.distractor_concept), phrase.article)
    return None


def _absent_phrase(item: Item, items: Sequence[Item], seed: int) -> Phrase | None:
    """Return a phrase of the category whose concept is in neither picture.

    Comparisons, such as "less smiling person", hold of some picture of every pair of their kind. Where a category
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


# -- templates ---------------------------------------------------------------------------------------------------


Order = Literal["original", "swapped"]
"""The side that is named first: left (`original`), or right (`swapped`)."""
ORDERS: tuple[Order, Order] = ("original", "swapped")
SIDE_TOKENS, LETTER_TOKENS = 24, 8
"""The tokens that an answer in words, and one by letter, may have."""
_PLACES = re.compile(r"\{(\w*)\}")
_FILLED = re.compile(r"\bthe \{object\}|\{object\}|\{A\}|\{B\}")
_LETTERED = re.compile(r"\bA\b[^\w{}]*\{A\}.*\bB\b[^\w{}]*\{B\}", re.DOTALL)
_YES_OR_NO = re.compile(r"\byes or no\b", re.IGNORECASE)


@dataclass(frozen=True)
class Template:
    """A prompt whose places are still open.

    Attributes:
        name: The name in runs and tables.
        text: The words with places such as `{object}`.

    Raises:
        UsageError: For places that a prompt cannot have.
    """

    name: str
    text: str

    def __post_init__(self) -> None:
        places = _PLACES.findall(self.text)
        if places == ["instruction"]:
            return
        if unknown := sorted(set(places) - {"object", "A", "B"}):
            raise UsageError(
                f"the prompt {self.name} has a place {{{unknown[0]}}}; expected {{object}}, {{A}} and {{B}}, or "
                "{instruction} and no other"
            )
        if places.count("object") != 1 or (places.count("A"), places.count("B")) not in ((0, 0), (1, 1)):
            raise UsageError(
                f"the prompt {self.name} has the places {', '.join(places) or 'none'}; expected {{object}} once, "
                "and {A} and {B} once each or not at all"
            )
        if self.lettered and self.text.index("{A}") > self.text.index("{B}"):
            raise UsageError(f"the prompt {self.name} names option B before option A; name A first")

    @cached_property
    def sha256(self) -> str:
        """The hash of the text, including its places."""
        return sha256_text(self.text)

    @property
    def is_instruction(self) -> bool:
        """Whether the prompt is the instruction that policies get, and asks for no object."""
        return "{instruction}" in self.text

    @property
    def lettered(self) -> bool:
        """Whether answers are the letters A and B."""
        return _LETTERED.search(self.text) is not None

    @property
    def orders(self) -> tuple[Order, ...]:
        """The orders in which the sides can be named; one for a prompt without places for them."""
        return ORDERS if "{A}" in self.text else ORDERS[:1]

    @property
    def yes_or_no(self) -> bool:
        """Whether the prompt first asks if the object is visible, so that "no" is an answer."""
        return _YES_OR_NO.search(self.text) is not None

    @property
    def tokens(self) -> int:
        """The number of tokens that an answer may have."""
        return LETTER_TOKENS if self.lettered else SIDE_TOKENS

    def render(self, phrase: Phrase, order: Order = "original", instruction: str = "") -> str:
        """Return the question about an object, with the sides in this order and the episode's instruction."""
        if self.is_instruction:
            return self.text.replace("{instruction}", instruction)
        first, second = sides(order)
        words = {"the {object}": phrase.with_article, "{object}": phrase.text, "{A}": first, "{B}": second}
        return _FILLED.sub(lambda match: words[match[0]], self.text)


def sides(order: Order) -> tuple[Side, Side]:
    """Return the side that is named first and the one that is named second."""
    first: Side = "left" if order == "original" else "right"
    return first, other_side(first)


_CHOICE = "\n\nA {A}\nB {B}\n\nAnswer with the option's letter from the given choices directly."
SEEN = Template("seen", "Do you see the {object}? Answer yes or no. If yes, specify where: {A}, center, or {B}.")
P1 = Template("p1", 'Do you see the {object}? If yes, specify where: "left" or "right".' + _CHOICE)
P2 = Template("p2", "Put cube on {object}" + _CHOICE)
INSTRUCTION = Template("instruction", "{instruction}")
TEMPLATES: Mapping[str, Template] = MappingProxyType(
    {template.name: template for template in (SEEN, P1, P2, INSTRUCTION)}
)
"""The templates of the paper, and the instruction, by name."""


def find_template(name: str) -> Template:
    """Return a template of `TEMPLATES`, or the one in a text file, named after the file.

    Raises:
        UsageError: If it is neither, or if the file's places are not those of a prompt.
    """
    if name in TEMPLATES:
        return TEMPLATES[name]
    path = Path(name).expanduser()
    if not path.is_file():
        raise UsageError(
            f"there is no prompt {name!r}; known: {', '.join(TEMPLATES)}, or a text file with {{object}}"
        )
    try:
        text = read_regular_text(path)
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}. Give a text file with {{object}}") from error
    except UnicodeDecodeError:
        raise UsageError(f"{path} is not UTF-8 text; write the prompt as plain text with {{object}}") from None
    return Template(re.sub(r"[^\w-]+", "-", path.stem), text.rstrip("\n"))


# -- pictures side by side ---------------------------------------------------------------------------------------


GREY = (128, 128, 128)
MARGIN = 0.05
"""The share of the width at every edge and between the pictures."""


def side_by_side(episode: Episode, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return left and right picture of the episode on grey, (H, W, 3) uint8 of `shape`.

    Both are equally large, as large as fits.

    Raises:
        SuiteError: For a picture that is missing or damaged.
    """
    height, width = shape
    gap = round(MARGIN * width)
    side = min((width - 3 * gap) // 2, height - 2 * gap)
    canvas = Image.new("RGB", (width, height), GREY)
    for number, picture in enumerate((episode.picture("left"), episode.picture("right"))):
        drawn = load_picture(picture).resize((side, side), Image.Resampling.LANCZOS)
        middle = width // 4 if number == 0 else width - width // 4
        canvas.paste(drawn, (middle - side // 2, (height - side) // 2))
    return np.asarray(canvas)
