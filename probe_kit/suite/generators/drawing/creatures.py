"""Concepts of Living World: animals and plants by kind, and lifeless things, each with its icon."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Creature:
    """An animal or plant; `view` is how much of it the icon shows."""

    name: str
    icon: str
    family: str
    view: Literal["whole", "face"]


def _family(family: str, names: str, view: Literal["whole", "face"] = "whole") -> list[Creature]:
    """Creatures of one family from words like `fox` or, where the icon has another name, `bee=honeybee`."""
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
