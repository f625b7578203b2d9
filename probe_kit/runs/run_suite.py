"""The suite of a run: from a folder, from the folder it was extracted with, or drawn again."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit.errors import SuiteError, SuiteNotFoundError, UsageError
from probe_kit.runs.reader import RunReader

if TYPE_CHECKING:
    from probe_kit.suite import Suite


_GIVE = "Give the folder of that suite (--suite, suite=…)"


def suite_of(run: RunReader, folder: Path | None = None) -> "Suite":
    """Return the run's suite, from a folder that may hold more than the run's items.

    Without `folder` it is read from the folder that the run was extracted with, if that still holds the suite.
    Else the run's part of the embedded suite is found in the cache or drawn again. These are the same items
    whatever else the cache holds.

    Args:
        run: Run whose pictures are needed.
        folder: Folder of the suite.

    Raises:
        SuiteError: For another suite in `folder`, or a damaged one.
        SuiteNotFoundError: Without a folder, if the run's suite is neither in its folder nor the embedded one, or
            is drawn differently here.
    """
    if folder is not None:
        return _in_folder(run, folder)
    moved = []
    for source_folder in dict.fromkeys(origin.suite for origin in run.origins if origin.suite):
        try:
            return _in_folder(run, Path(source_folder))
        except UsageError:
            moved.append(f"The folder {source_folder} of its extraction is gone")
        except SuiteError as error:
            moved.append(f"The folder {source_folder} of its extraction no longer holds it: {error}")
    try:
        return _embedded_suite(run)
    except SuiteNotFoundError as error:
        if not moved:
            raise
        raise SuiteNotFoundError(f"{error}. {'. '.join(moved)}") from error


def _in_folder(run: RunReader, folder: Path) -> "Suite":
    from probe_kit.suite import load_suite

    suite = load_suite(folder)
    if not _holds(suite, run):
        raise SuiteError(
            f"{folder} holds {suite.identity}, and its items that {run.location} has hash to "
            f"{_hash_of_part(suite, run)[:12]}; the run was extracted from {run.suite}. Give that suite's folder"
        )
    return suite


def _embedded_suite(run: RunReader) -> "Suite":
    from probe_kit.suite.build import default_identity
    from probe_kit.suite.generators import GENERATORS

    drawable = default_identity()
    counts = Counter(run.planned_items.values())
    if run.suite.rpartition("#")[0] != drawable or not counts.keys() <= GENERATORS.keys():
        raise SuiteNotFoundError(
            f"{run.location} was extracted from {run.suite}, whose pictures are needed; only those of {drawable} "
            f"can be drawn again. {_GIVE}"
        )
    try:
        drawn = next((suite for suite in _draw_suite(counts) if _holds(suite, run)), None)
    except OSError as error:
        raise SuiteNotFoundError(
            f"{run.location} was extracted from {run.suite}, whose pictures are needed and cannot be drawn again: "
            f"{error}. Name a folder that can be written in PROBE_KIT_CACHE. {_GIVE}"
        ) from error
    if drawn is None:
        raise SuiteNotFoundError(
            f"{run.location} was extracted from {run.suite}, whose pictures are needed; drawn again they are "
            f"others, so it was drawn with another seed or other versions of what draws. {_GIVE}"
        )
    planned = run.planned_items
    return replace(drawn, items=tuple(item for item in drawn.items if item.item_id in planned))


def _draw_suite(counts: Mapping[str, int]) -> Iterator["Suite"]:
    """Yield the embedded suites that a run with so many items per category can come from, the cheapest first."""
    from probe_kit.suite import load_suite
    from probe_kit.suite.build import ITEMS, default_folder, default_suite

    for cached in (default_folder(), default_folder(list(counts))):
        if cached.is_dir():
            yield load_suite(cached)
    as_many = max(counts.values())
    for size in dict.fromkeys((as_many + as_many % 2, ITEMS)):  # groups may differ where more items share pictures
        yield default_suite(list(counts), size)


def _holds(suite: "Suite", run: RunReader) -> bool:
    expected = run.suite.rpartition("#")[2]
    return suite.content_sha256.startswith(expected) or _hash_of_part(suite, run).startswith(expected)


def _hash_of_part(suite: "Suite", run: RunReader) -> str:
    """Return the hex sha256 that `suite` had with only those items that the run has."""
    planned = run.planned_items
    return suite.content_sha256_of(item for item in suite.items if item.item_id in planned)
