"""Living World: "picture of the fox" against another animal or plant, "living thing" against a thing."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from probe_kit.suite.generators.drawing import (
    Canvas,
    Placement,
    Tile,
    background_for,
    color_icon,
    mean_color,
    random_placement,
)
from probe_kit.suite.generators.generator import Concept, Generator, each, half_within, none_alike, spread_pairs


@dataclass(frozen=True)
class Creature:
    """An animal or plant; `view` says how much of it the icon shows."""

    name: str
    icon: str
    family: str
    view: Literal["whole", "face"]


def _family(family: str, names: str, view: Literal["whole", "face"] = "whole") -> list[Creature]:
    """Make creatures of one family from words like `fox` or, where the icon has another name, `bee=honeybee`."""
    creatures = []
    for word in names.split():
        name, _, icon = word.partition("=")
        creatures.append(Creature(name.replace("-", " "), icon or name, family, view))
    return creatures


CREATURES: tuple[Creature, ...] = (
    *_family(
        "mammal",
        "cat dog monkey gorilla tiger leopard horse deer bison cow pig sheep=ewe goat camel llama giraffe "
        "elephant rhinoceros hippopotamus mouse rabbit squirrel=chipmunk beaver hedgehog bat sloth otter "
        "skunk kangaroo badger donkey",
    ),
    *_family("mammal", "raccoon boar fox lion bear panda koala wolf hamster moose", "face"),
    *_family("bird", "turkey penguin eagle duck owl flamingo peacock parrot chick=baby-chick goose"),
    *_family(
        "sea animal",
        "whale dolphin seal tropical-fish blowfish shark octopus jellyfish crab lobster shrimp squid oyster",
    ),
    *_family("reptile", "crocodile turtle lizard snake"),
    *_family(
        "small animal",
        "snail butterfly caterpillar=bug ant bee=honeybee beetle ladybug=lady-beetle grasshopper=cricket spider "
        "scorpion mosquito fly worm",
    ),
    *_family("flower", "rose tulip sunflower hibiscus cherry-blossom daisy=blossom hyacinth lotus"),
    *_family(
        "plant",
        "seedling potted-plant pine-tree=evergreen-tree leafy-tree=deciduous-tree palm-tree cactus "
        "rice=sheaf-of-rice herb clover=shamrock mushroom",
    ),
)

# Too much alike on a small tile, or one name covers both.
LOOK_ALIKES: tuple[set[str], ...] = (
    {"cat", "dog"},
    {"monkey", "gorilla"},
    {"tiger", "leopard"},
    {"sheep", "goat", "llama"},
    {"horse", "donkey"},
    {"rhinoceros", "hippopotamus"},
    {"beaver", "hedgehog", "otter"},
    {"skunk", "badger"},
    {"bear", "panda", "koala", "hamster"},
    {"raccoon", "wolf"},
    {"duck", "goose"},
    {"whale", "dolphin", "seal"},
    {"tropical fish", "blowfish"},
    {"octopus", "jellyfish", "squid"},
    {"crab", "lobster", "shrimp", "scorpion"},
    {"ant", "spider", "beetle"},
    {"bee", "fly", "mosquito"},
    {"caterpillar", "worm", "snake", "grasshopper"},
    {"hibiscus", "cherry blossom"},
    {"pine tree", "leafy tree"},
    {"seedling", "potted plant", "herb"},
)

THINGS: tuple[str, ...] = (
    *("chair", "bed", "bicycle", "automobile", "bus", "rocket", "hammer", "scissors", "key", "umbrella"),
    *("teapot", "bell", "guitar", "trumpet", "telephone", "laptop", "camera", "backpack", "toilet", "broom"),
    *("bucket", "anchor", "tractor", "house", "crown", "drum", "spoon"),
)


_ICON_HEIGHT = 1.6  # turned by 8 degrees and moved by 5 %, its corners stay on the tile
_TURN = 8
_ALIVE_SHARE = 6  # one pair in six asks for what is alive or not


@dataclass(frozen=True)
class Depicted(Concept):
    """The subject of an icon."""

    icon: str = ""


@dataclass(frozen=True)
class Portrait(Tile):
    """Everything that the picture is drawn from: one icon; `ink` is its average colour."""

    icon: str
    placement: Placement

    def _paint(self, canvas: Canvas) -> None:
        canvas.pen(self.placement).stamp(color_icon(self.icon), 0, 0, _ICON_HEIGHT)


def _portrait(concept: Depicted, rng: np.random.Generator) -> Portrait:
    ink = mean_color(concept.icon)
    background = background_for(ink, rng)
    return Portrait(concept.icon, random_placement(rng, (0.9, 1.0), turn=_TURN), ink=ink, background=background)


def _animal_pairs() -> tuple[tuple[Depicted, Depicted], ...]:
    """Return the pairs of creatures, half of them inside one family; never a whole animal next to a mere face."""
    creature_of = {creature.name: creature for creature in CREATURES}
    unlike = none_alike(LOOK_ALIKES)

    def creature(concept: Depicted) -> Creature:
        return creature_of[concept.name]

    return half_within(
        [Depicted(c.name, f"picture of the {c.name}", icon=c.icon) for c in CREATURES],
        family=lambda concept: creature(concept).family,
        allowed=lambda a, b: creature(a).view == creature(b).view and unlike(a, b),
    )


def _alive_or_not(count: int) -> tuple[tuple[Depicted, Depicted], ...]:
    """Return pairs of a living thing and one that is not; every creature and every thing about equally often."""
    living = [Depicted("living thing", "living thing", icon=c.icon) for c in CREATURES]
    dead = [Depicted("thing that is not alive", "thing that is not alive", icon=icon) for icon in THINGS]
    return spread_pairs(living + dead, lambda a, b: a.name != b.name, most=count)


_NAMED = _animal_pairs()
LIVING_WORLD = Generator(
    category="living-world",
    pairs=_NAMED + _alive_or_not(len(_NAMED) // (_ALIVE_SHARE - 1)),
    tiles=each(_portrait),
)
