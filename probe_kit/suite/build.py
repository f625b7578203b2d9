"""Building of the embedded suite `a2a-embedded`: no downloads, and the same bytes for the same options.

Its items are procedural. They follow Act2Answer's procedure with pictures of our own, so results on them must
never be mixed with, or called, the paper's numbers. Each couple of tiles gives two items: the same pictures in the
same places, each the target once. Neither the pictures alone nor the text alone can give the answer away.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from probe_kit._system.user_cache import user_cache
from probe_kit.errors import UsageError
from probe_kit.hashing import sha256_json, sha256_text
from probe_kit.suite.categories import CATEGORIES, check_categories
from probe_kit.suite.generators import GENERATORS
from probe_kit.suite.generators.generator import SUITE_NAME, SUITE_VERSION, Couple, Generator, draw_couples
from probe_kit.suite.items import Item, Side, instruction_for, side_words, with_groups
from probe_kit.suite.manifest import check_foreign_folder, load_suite, save_suite
from probe_kit.suite.suite import Picture, Suite, drawing_libraries, make_item, new_suite, picture_of

ATTRIBUTION = "probe_kit"
LICENSE = "Apache-2.0"


@dataclass(frozen=True)
class Twins:
    """Two items over the same two pictures."""

    items: tuple[Item, Item]
    pictures: tuple[Picture, Picture]


def draw_twins(category: str, count: int, seed: int) -> Iterator[Twins]:
    """Draw the first `count` twins of one category; a smaller count gives the beginning of a larger one."""
    generator = GENERATORS[category]
    for number, couple in enumerate(islice(draw_couples(generator, seed), count)):
        left_picture, right_picture = (
            picture_of(f"{SUITE_NAME}/{category}/{sha256_json(tile.record())[:16]}", tile.draw())
            for tile in (couple.left_tile, couple.right_tile)
        )
        pictures = left_picture, right_picture
        gen = {
            "generator": category,
            "version": SUITE_VERSION,
            "seed": seed,
            "couple": number,
            "left": couple.left_tile.record(),
            "right": couple.right_tile.record(),
        }
        sides: tuple[Side, Side] = ("left", "right") if couple.left_asked_first else ("right", "left")
        first, second = (_item(couple, pictures, side, gen, generator) for side in sides)
        yield Twins((first, second), pictures)


def _item(
    couple: Couple,
    pictures: tuple[Picture, Picture],
    side: Side,
    gen: dict[str, Any],
    generator: Generator[Any],
) -> Item:
    """Make the item that asks for the picture on `side`; its group is not known yet."""
    category = gen["generator"]
    target, distractor = (couple.left, couple.right) if side == "left" else (couple.right, couple.left)
    pair_id = f"{SUITE_NAME}-{category}-s{gen['seed']}-{gen['couple']:04d}"
    instruction = instruction_for(target.phrase, "the")
    tiles = (couple.left_tile, couple.right_tile) if side == "left" else (couple.right_tile, couple.left_tile)
    content = {"instruction": instruction, "correct_side": side, "gen": gen}
    name, other_name = (generator.name_of(tile) if generator.name_of else "" for tile in tiles)
    tells = name and name != other_name and not side_words(name)  # else the words would fit both or name a side
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
        wordings={"named": instruction_for(name, "the")} if tells else {},
    )


CountItems = Callable[[int, int], None]


# -- the suite ---------------------------------------------------------------------------------------------------


ITEMS = 150
"""Default number of items per category."""


def build_suite(
    folder: Path | str,
    categories: Sequence[str] | None = None,
    items_per_category: int | Mapping[str, int] = ITEMS,
    seed: int = 0,
    progress: CountItems | None = None,
) -> Suite:
    """Draw the embedded suite and write it to `folder`.

    Args:
        folder: Folder to write; new or empty, or with this very suite.
        categories: Names of categories, None for all embedded ones. The items of a category do not depend on which
            other ones are built, and fewer items per category are the beginning of more.
        items_per_category: One number, or a number for each of `categories`; positive and even.
        seed: Seed of the drawn items.
        progress: Function that is called with the number of items done and of all items; None for no reports.

    Raises:
        UnknownCategoryError: For a category that is not embedded.
        UsageError: For no category, a number of items that is not positive and even, or a category without a
            number.
        SuiteError: If `folder` contains anything but this very suite.
    """
    folder = Path(folder)
    options = _options(categories, items_per_category, seed)
    counts = _counts(options["categories"], options["items_per_category"])
    check_foreign_folder(folder)
    items: list[Item] = []
    pictures: dict[str, bytes] = {}
    for category, count in counts.items():
        for twins in draw_twins(category, count // 2, seed):
            items += twins.items
            pictures |= {picture.file_name: picture.png for picture in twins.pictures}
            if progress:
                progress(len(items), sum(counts.values()))
    suite = new_suite(SUITE_NAME, SUITE_VERSION, with_groups(items), options)
    return save_suite(suite, pictures, _stats(suite), folder)


def default_suite(
    categories: Sequence[str] | None = None,
    items_per_category: int = ITEMS,
    seed: int = 0,
    progress: CountItems | None = None,
) -> Suite:
    """Return the embedded suite, built on first use and kept in `$PROBE_KIT_CACHE` or `~/.cache/probe_kit`.

    Arguments and errors are those of `build_suite`.
    """
    folder = default_folder(categories, items_per_category, seed)
    if folder.is_dir():
        return load_suite(folder)
    return build_suite(folder, categories, items_per_category, seed, progress)


def default_folder(
    categories: Sequence[str] | None = None, items_per_category: int = ITEMS, seed: int = 0
) -> Path:
    """Return the folder in which `default_suite` keeps the suite of these arguments, built or not."""
    key = _cache_key(_options(categories, items_per_category, seed))
    return user_cache() / "suites" / f"{default_identity().replace('@', '-')}-{key}"


def default_identity() -> str:
    """Return `name@version` of the suite that `default_suite` draws."""
    return f"{SUITE_NAME}@{SUITE_VERSION}"


def _options(
    categories: Sequence[str] | None, items_per_category: int | Mapping[str, int], seed: int
) -> dict[str, Any]:
    """Check the arguments and return them in one spelling: equal numbers of items are one number."""
    embedded = [slug for slug in CATEGORIES if slug in GENERATORS]
    requested = embedded if categories is None else check_categories(categories, embedded)
    if not requested:
        raise UsageError("no category to build. Name at least one, or leave `categories` out for all.")
    ordered = [slug for slug in embedded if slug in requested]
    counts = _counts(ordered, items_per_category)
    for count in counts.values():
        if count < 2 or count % 2:
            raise UsageError(
                f"{count} items per category are asked for; expected a positive even number, because every pair "
                "of pictures is asked for both ways."
            )
    different = set(counts.values())
    return {
        "categories": ordered,
        "items_per_category": counts if len(different) > 1 else different.pop(),
        "seed": seed,
    }


def _counts(categories: Sequence[str], items_per_category: int | Mapping[str, int]) -> dict[str, int]:
    if isinstance(items_per_category, int):
        return dict.fromkeys(categories, items_per_category)
    if items_per_category.keys() != set(categories):
        raise UsageError(
            f"items_per_category has a number for {', '.join(sorted(items_per_category)) or 'no category'}; "
            f"expected one for each of {', '.join(sorted(categories))}."
        )
    return {category: items_per_category[category] for category in categories}


def _stats(suite: Suite) -> dict[str, dict[str, int]]:
    """Count the different pairs of concepts and the items of each category."""
    return {
        category: {"pool": len(GENERATORS[category].pairs), "emitted": emitted}
        for category, emitted in suite.card["counts"].items()
    }


def _cache_key(options: Mapping[str, Any]) -> str:
    """Return a name for all that a built suite depends on, so that changed code never uses an old cache.

    It depends on the libraries that draw, and on the code that draws, words, groups and lays out. The art needs no
    hash of its own: the notice in its folder contains its checksums.
    """
    folder = Path(__file__).parent
    modules = ("build", "categories", "items", "manifest", "pictures", "suite")
    sources = [
        *sorted((folder / "generators").rglob("*.py")),
        *(folder / f"{name}.py" for name in modules),
        folder / "art" / "NOTICE.md",
    ]
    code = sha256_text("\n".join(source.read_text(encoding="utf-8") for source in sources))
    return sha256_json({"options": options, "code": code, "libraries": drawing_libraries()})[:12]
