"""Two items of a couple of tiles: the same pictures in the same places, each the target once.

Each concept is so the target once and the distractor once in the very same pictures. Neither the pictures alone
nor the text alone can give the answer away; only both together do.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import islice
from typing import Any

from probe_kit.hashing import sha256_json
from probe_kit.suite.generators import GENERATORS
from probe_kit.suite.generators.canvas import Tile
from probe_kit.suite.generators.generator import SUITE_NAME, SUITE_VERSION, Couple, Generator, draw_couples
from probe_kit.suite.items import Item, Side
from probe_kit.suite.making import Picture, make_item, picture_of
from probe_kit.suite.wording import instruction_for, side_words

ATTRIBUTION = "probe_kit"
LICENSE = "Apache-2.0"


@dataclass(frozen=True)
class Twins:
    """Two items over the same two pictures."""

    items: tuple[Item, Item]
    pictures: tuple[Picture, Picture]


def draw_twins(category: str, count: int, seed: int) -> Iterator[Twins]:
    """The first `count` twins of one category; a smaller count gives the beginning of a larger one."""
    generator = GENERATORS[category]
    for number, couple in enumerate(islice(draw_couples(generator, seed), count)):
        pictures = _draw(category, couple.left_tile), _draw(category, couple.right_tile)
        gen = {
            "generator": category,
            "version": SUITE_VERSION,
            "seed": seed,
            "couple": number,
            "left": asdict(couple.left_tile),
            "right": asdict(couple.right_tile),
        }
        sides: tuple[Side, Side] = ("left", "right") if couple.left_asked_first else ("right", "left")
        first, second = (_item(couple, pictures, side, gen, generator) for side in sides)
        yield Twins((first, second), pictures)


def _draw(category: str, tile: Tile) -> Picture:
    return picture_of(f"{SUITE_NAME}/{category}/{sha256_json(asdict(tile))[:16]}", tile.draw())


def _item(
    couple: Couple,
    pictures: tuple[Picture, Picture],
    side: Side,
    gen: dict[str, Any],
    generator: Generator[Any],
) -> Item:
    """The item that asks for what lies on `side`; its group is not known yet."""
    category = gen["generator"]
    target, distractor = (couple.left, couple.right) if side == "left" else (couple.right, couple.left)
    pair_id = f"{SUITE_NAME}-{category}-s{gen['seed']}-{gen['couple']:04d}"
    instruction = instruction_for(target.phrase, "the")
    tiles = (couple.left_tile, couple.right_tile) if side == "left" else (couple.right_tile, couple.left_tile)
    content = {"instruction": instruction, "correct_side": side, "gen": gen}
    return make_item(
        f"{SUITE_NAME}-{category}-{sha256_json(content)[:10]}",
        category,
        side,
        pictures,
        transfer_type="procedural",
        construction="procedural",
        instruction=instruction,
        object_phrase=target.phrase,
        object_article="the",
        polarity=target.polarity,
        target_concept=target.name,
        distractor_concept=distractor.name,
        pair_id=pair_id,
        rule_id="procedural",
        license=LICENSE,
        attribution=ATTRIBUTION,
        redistributable=True,
        contains_real_face=False,
        source={
            "benchmark": SUITE_NAME,
            "version": gen["version"],
            "split": "eval",
            "source_id": pair_id,
            "url": "",
        },
        gen=gen,
        wordings=_wordings(generator, *tiles),
    )


def _wordings(generator: Generator[Any], target: Tile, distractor: Tile) -> dict[str, str]:
    """Return the item's other wordings; none if the words would fit both tiles or name a side."""
    name, distractor_name = (generator.name_of(tile) if generator.name_of else "" for tile in (target, distractor))
    tells = name and name != distractor_name and not side_words(name)
    return {"named": instruction_for(name, "the")} if tells else {}
