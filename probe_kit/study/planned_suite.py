"""The suite of a study as far as a plan needs it: categories and items, without drawing a picture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from probe_kit.study.mistakes import Mistake
from probe_kit.study.schema import SuiteTable
from probe_kit.suite.categories import in_order


@dataclass(frozen=True)
class PlannedSuite:
    """A suite as far as a plan needs it.

    identity: `name@version`; when a run grows, items are compared by content. items: by category. folder: None for
    the embedded suite. source: where the numbers of items are from. contents: hash of every item's content by its
    id, of a suite in a folder; empty for others.
    """

    identity: str
    items: Mapping[str, int]
    folder: Path | None
    source: str
    contents: Mapping[str, str] = field(default_factory=dict)


def planned_suite(table: SuiteTable) -> tuple[PlannedSuite, list[Mistake]]:
    """The suite that a file names, and what is wrong with it."""
    if table.path is None:
        return _embedded(), []
    folder = Path(table.path)
    counts = {slug(name): count for name, count in table.counts.items()}
    if folder.is_dir():
        return _from_folder(folder, table.counts)
    if counts:
        ordered = {name: counts[name] for name in in_order(counts)}
        return PlannedSuite(f"not here: {table.path}", ordered, folder, "suite.counts"), []
    text = f"there is no folder {folder}. Make the suite, or give items per category in [suite.counts] for a plan"
    return _unknown(table.path, folder, text)


def _unknown(name: str, folder: Path, why: str) -> tuple[PlannedSuite, list[Mistake]]:
    return PlannedSuite(f"not here: {name}", {}, folder, "nothing"), [Mistake(("suite", "path"), why)]


def slug(name: str) -> str:
    """The slug of a category that was named by slug or title, in any case."""
    return "-".join(name.lower().split())


def slugs(names: Sequence[str]) -> tuple[str, ...]:
    """The same of several, each once, in order."""
    return tuple(dict.fromkeys(map(slug, names)))


@cache
def _embedded() -> PlannedSuite:
    from probe_kit.suite.build import ITEMS, default_identity
    from probe_kit.suite.generators import GENERATORS

    return PlannedSuite(default_identity(), dict.fromkeys(in_order(GENERATORS), ITEMS), None, "the embedded suite")


def _from_folder(folder: Path, counts: Mapping[str, int]) -> tuple[PlannedSuite, list[Mistake]]:
    from probe_kit.errors import SuiteError
    from probe_kit.suite import load_suite
    from probe_kit.suite.suite import count_by_category

    try:
        suite = load_suite(folder)
    except SuiteError as error:
        return _unknown(str(folder), folder, str(error))
    items = count_by_category(suite.items)
    wrong = [
        Mistake(
            ("suite", "counts", name),
            f"{slug(name)} has {items.get(slug(name), 0)} items in {folder}, not {count}",
        )
        for name, count in counts.items()
        if items.get(slug(name)) != count
    ]
    contents = {item.item_id: item.content_sha256 for item in suite.items}
    identity = f"{suite.name}@{suite.version}"
    return PlannedSuite(identity, items, folder, str(folder), contents=contents), wrong
