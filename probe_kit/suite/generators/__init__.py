"""The embedded suite's categories, each with the concepts it asks for and the pictures it draws."""

from typing import Any

from probe_kit.suite.generators.attribute import ATTRIBUTE
from probe_kit.suite.generators.counting import COUNTING
from probe_kit.suite.generators.drawing import Tile
from probe_kit.suite.generators.emotion import EMOTION
from probe_kit.suite.generators.generator import Concept, Generator
from probe_kit.suite.generators.living_world import LIVING_WORLD
from probe_kit.suite.generators.public_info import PUBLIC_INFO
from probe_kit.suite.generators.shapes import COLOR, SHAPE, SYMMETRY
from probe_kit.suite.generators.state import STATE
from probe_kit.suite.generators.time import TIME
from probe_kit.suite.generators.traffic import TRAFFIC
from probe_kit.suite.items import instruction_for

__all__ = ["GENERATORS", "Concept", "Generator", "Tile", "vocabulary"]

_ALL = (
    *(EMOTION, ATTRIBUTE, STATE, COLOR, SHAPE, SYMMETRY),
    *(COUNTING, TIME, PUBLIC_INFO, TRAFFIC, LIVING_WORLD),
)
GENERATORS: dict[str, Generator[Any]] = {generator.category: generator for generator in _ALL}
"""The generator of each category, by name."""


def vocabulary() -> list[str]:
    """Return every lower-case word that an instruction of the embedded suite can contain, sorted."""
    concepts = [concept for generator in GENERATORS.values() for pair in generator.pairs for concept in pair]
    sentences = {instruction_for(concept.phrase, "the") for concept in concepts}
    return sorted({word for sentence in sentences for word in sentence.lower().split()})
