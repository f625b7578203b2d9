"""From a couple of tiles to two items: the same pictures in the same places, asked for both ways.

Each concept is so the target once and the distractor once in the very same pictures. Neither the pictures alone
nor the text alone can give the answer away; only both together do.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import islice
from typing import Any

from probe_kit.identity import sha256_json
from probe_kit.suite.categories import CATEGORIES
from probe_kit.suite.generators import GENERATORS
from probe_kit.suite.generators.couples import SUITE_NAME, SUITE_VERSION, Couple, draw_couples
from probe_kit.suite.generators.generator import Tile
from probe_kit.suite.items import Item, Side
from probe_kit.suite.pictures import encode_png, picture_file_name, pixels_sha256
from probe_kit.suite.wording import instruction_for

ATTRIBUTION = "probe_kit"
LICENSE = "Apache-2.0"


@dataclass(frozen=True)
class Picture:
    """A drawn tile with all that an item records about it."""

    tile: dict[str, Any]
    image_id: str
    png: bytes
    pixels_sha256: str

    @property
    def file_name(self) -> str:
        """Where it lies inside the suite's `items/`."""
        return picture_file_name(self.pixels_sha256)


@dataclass(frozen=True)
class Twins:
    """Two items over the same two pictures."""

    items: tuple[Item, Item]
    pictures: tuple[Picture, Picture]


def draw_twins(category: str, count: int, seed: int) -> Iterator[Twins]:
    """The first `count` twins of one category; a smaller count gives the beginning of a larger one."""
    for number, couple in enumerate(islice(draw_couples(GENERATORS[category], seed), count)):
        pictures = _draw(category, couple.left_tile), _draw(category, couple.right_tile)
        gen = {
            "generator": category,
            "version": SUITE_VERSION,
            "seed": seed,
            "couple": number,
            "left": pictures[0].tile,
            "right": pictures[1].tile,
        }
        sides: tuple[Side, Side] = ("left", "right") if couple.left_asked_first else ("right", "left")
        first, second = (_item(couple, pictures, side, gen) for side in sides)
        yield Twins((first, second), pictures)


def _draw(category: str, tile: Tile) -> Picture:
    image = tile.draw()
    parameters = asdict(tile)
    return Picture(
        tile=parameters,
        image_id=f"{SUITE_NAME}/{category}/{sha256_json(parameters)[:16]}",
        png=encode_png(image),
        pixels_sha256=pixels_sha256(image),
    )


def _item(couple: Couple, pictures: tuple[Picture, Picture], side: Side, gen: dict[str, Any]) -> Item:
    """The item that asks for what lies on `side`; its group is not known yet."""
    left, right = pictures
    category = CATEGORIES[gen["generator"]]
    target, distractor = (couple.left, couple.right) if side == "left" else (couple.right, couple.left)
    pair_id = f"{SUITE_NAME}-{category.slug}-s{gen['seed']}-{gen['couple']:04d}"
    instruction = instruction_for(target.phrase, "the")
    content = sha256_json({"instruction": instruction, "correct_side": side, "gen": gen})
    return Item(
        item_id=f"{SUITE_NAME}-{category.slug}-{content[:10]}",
        category=category.slug,
        domain=category.domain,
        transfer_type="procedural",
        construction="procedural",
        instruction=instruction,
        object_phrase=target.phrase,
        object_article="the",
        polarity=target.polarity,
        target_concept=target.name,
        distractor_concept=distractor.name,
        correct_side=side,
        left_file_name=left.file_name,
        right_file_name=right.file_name,
        left_sha256=hashlib.sha256(left.png).hexdigest(),
        right_sha256=hashlib.sha256(right.png).hexdigest(),
        left_pixels_sha256=left.pixels_sha256,
        right_pixels_sha256=right.pixels_sha256,
        left_image_id=left.image_id,
        right_image_id=right.image_id,
        group_id="",
        pair_id=pair_id,
        rule_id="procedural",
        curation_status="rules-only",
        license=LICENSE,
        attribution=ATTRIBUTION,
        redistributable=True,
        contains_real_face=False,
        split="eval",
        source={
            "benchmark": SUITE_NAME,
            "version": SUITE_VERSION,
            "split": "eval",
            "source_id": pair_id,
            "url": "",
        },
        gen=gen,
    )
