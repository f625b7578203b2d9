"""Prompt templates: text with placeholders for the object and the two sides.

Places in a template: `the {object}` is the object with its article, if it has one, `{object}` without; `{A}` and
`{B}` are the words for the two sides, in either order. A letter A in front of `{A}` and a letter B in front of
`{B}` make them options that are answered by their letter; without letters they are answered in words. A template
with `{instruction}` shows a VLM the words of the policies, to compare activations with theirs.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from probe_kit._system.bounded_files import read_regular_text
from probe_kit.errors import UsageError
from probe_kit.extract.vqa.phrases import Phrase
from probe_kit.hashing import sha256_text
from probe_kit.suite import Side
from probe_kit.suite.items import other_side

Order = Literal["original", "swapped"]
"""Which side is named first: left, or right."""
ORDERS: tuple[Order, Order] = ("original", "swapped")
SIDE_TOKENS, LETTER_TOKENS = 24, 8
"""Tokens that an answer in words, and one by letter, may have."""
_PLACES = re.compile(r"\{(\w*)\}")
_FILLED = re.compile(r"\bthe \{object\}|\{object\}|\{A\}|\{B\}")
_LETTERED = re.compile(r"\bA\b[^\w{}]*\{A\}.*\bB\b[^\w{}]*\{B\}", re.DOTALL)
_YES_OR_NO = re.compile(r"\byes or no\b", re.IGNORECASE)


@dataclass(frozen=True)
class Template:
    """A prompt with its places still open. Raises UsageError for places it cannot have.

    name: what runs and tables call it.
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
        """The hash of the text, places and all."""
        return sha256_text(self.text)

    @property
    def is_instruction(self) -> bool:
        """Whether it has the instruction that policies get, and asks for no object."""
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
        """Whether it first asks if the object is there, so that "no" is an answer."""
        return _YES_OR_NO.search(self.text) is not None

    @property
    def tokens(self) -> int:
        """The number of tokens that an answer may have."""
        return LETTER_TOKENS if self.lettered else SIDE_TOKENS

    def render(self, phrase: Phrase, order: Order = "original", instruction: str = "") -> str:
        """The question about an object, with the sides named in this order. instruction: of the episode."""
        if self.is_instruction:
            return self.text.replace("{instruction}", instruction)
        first, second = sides(order)
        words = {"the {object}": phrase.with_article, "{object}": phrase.text, "{A}": first, "{B}": second}
        return _FILLED.sub(lambda match: words[match[0]], self.text)


def sides(order: Order) -> tuple[Side, Side]:
    """The side that is named first and the one that is named second."""
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
"""Those of the paper, and the instruction, by name."""


def find_template(name: str) -> Template:
    """A template of `TEMPLATES`, or the one in a text file, called after it.

    Raises UsageError if it is neither, or if the file's places are not those of a prompt.
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
