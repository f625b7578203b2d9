"""Suites on disk: written atomically and checked whenever they are read.

  suite.json            identity card
  items/metadata.jsonl  one line per item; `datasets.load_dataset("imagefolder", data_dir=".../items")` reads it
  items/images/<xx>/<first 16 of the pixel hash>.png
  LICENSES.md  ATTRIBUTION.csv  stats.json

Nothing written depends on the clock or the machine's name: the same suite is the same bytes.
"""

import errno
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.drafts import draft_of
from probe_kit._system.escaping import csv_of_rows
from probe_kit.errors import SuiteError, UsageError
from probe_kit.suite.items import Item
from probe_kit.suite.rules import (
    LOADING_RULES,
    Finding,
    check_card,
    check_record,
    check_schema,
    error,
    listing,
    parse_line,
    unique_ids,
)
from probe_kit.suite.suite import Suite

CARD = "suite.json"
ITEMS = "items"
METADATA = "metadata.jsonl"
MOST_ITEMS = 100_000
"""Most items of a suite that is read; the largest existing suite has a twentieth of it."""


# -- writing -----------------------------------------------------------------------------------------


def save_suite(suite: Suite, pictures: Mapping[str, bytes], stats: Mapping[str, Any], folder: Path) -> Suite:
    """Write a suite, and return it as loaded from `folder`.

    The folder appears complete or not at all. If it exists already with this very suite, it is left alone. That is
    also how the slower of two processes that build at once ends.

    Args:
        suite: Suite in memory, see `new_suite`.
        pictures: PNG bytes by file name.
        stats: By category, how many candidates each stage left.
        folder: Folder to write; new or empty, or with this very suite.

    Raises:
        SuiteError: If the folder contains anything else.
    """
    if not _is_taken(folder):
        with draft_of(folder) as draft:
            _write(suite, pictures, stats, draft)
            try:
                draft.rename(folder)
            except OSError as error:
                if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                    raise
    check_foreign_folder(folder)
    stored = load_suite(folder)
    if stored.identity != suite.identity:
        raise SuiteError(
            f"{folder} already holds {stored.identity}; expected {suite.identity} or a new folder. "
            "Choose another folder, or delete this one if nothing was measured with it."
        )
    return stored


def check_foreign_folder(folder: Path) -> None:
    """Refuse a folder that is in use for something that is not a suite.

    Raises:
        SuiteError: If `folder` is such a folder.
    """
    if _is_taken(folder) and not (folder / CARD).is_file():
        raise SuiteError(
            f"{folder} exists and holds no suite; expected a new folder. Choose another one, or delete it."
        )


def _is_taken(folder: Path) -> bool:
    return folder.exists() and (not folder.is_dir() or any(folder.iterdir()))


def _write(suite: Suite, pictures: Mapping[str, bytes], stats: Mapping[str, Any], folder: Path) -> None:
    for name, encoded in pictures.items():
        path = folder / ITEMS / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encoded)
    lines = [json.dumps(item.to_json(), sort_keys=True, ensure_ascii=False) for item in suite.items]
    _write_text(folder / ITEMS / METADATA, "".join(f"{line}\n" for line in lines))
    _write_text(folder / CARD, _pretty(suite.card))
    _write_text(folder / "stats.json", _pretty(dict(stats)))
    _write_text(folder / "LICENSES.md", _licenses(suite.items))
    columns = ("file_name", "image_id", "license", "attribution")
    rows = {
        (name, image, item.license, item.attribution)
        for item in suite.items
        for name, image in (
            (item.left_file_name, item.left_image_id),
            (item.right_file_name, item.right_image_id),
        )
    }
    table = csv_of_rows(columns, (dict(zip(columns, row, strict=True)) for row in sorted(rows)))
    _write_text(folder / "ATTRIBUTION.csv", table)


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")


def _pretty(value: Any) -> str:
    return json.dumps(value, indent=2, sort_keys=True, ensure_ascii=False) + "\n"


def _licenses(items: Iterable[Item]) -> str:
    counts = Counter((item.license, item.redistributable) for item in items)
    rows = [
        f"| {license_id} | {'yes' if redistributable else 'no'} | {count} |"
        for (license_id, redistributable), count in sorted(counts.items())
    ]
    head = ["# Licences of this suite's pictures", "", "| licence | redistributable | items |", "|---|---|---|"]
    return "\n".join([*head, *rows, ""])


# -- reading -----------------------------------------------------------------------------------------


def load_suite(folder: Path | str) -> Suite:
    """Load the suite in `folder`, and check that every file is as it was written.

    Raises:
        UsageError: If there is no suite.
        SuiteError: For a suite with errors; the message lists all of them.
    """
    folder = Path(folder).absolute()
    suite, findings = read_suite(folder)
    if suite is None or findings:
        noun = "error" if len(findings) == 1 else "errors"
        raise SuiteError(
            f"the suite in {folder} has {len(findings)} {noun}:\n{listing(findings)}\n"
            "Restore the files, or delete the folder and build or convert the suite again."
        )
    return suite


def read_suite(folder: Path) -> tuple[Suite | None, list[Finding]]:
    """Read the suite as far as possible, and every error found on the way.

    The suite is None if its card cannot be read.

    Raises:
        UsageError: If there is no suite.
    """
    card = _read_card(folder)
    if isinstance(card, list):
        return None, card
    items, findings = _read_items(folder / ITEMS)
    suite = Suite(card["name"], card["version"], items, folder, card)
    findings += [finding for rule in LOADING_RULES for finding in rule(suite)]
    return suite, findings


def _read_card(folder: Path) -> dict[str, Any] | list[Finding]:
    path = folder / CARD
    if not path.is_file():
        raise UsageError(
            f"{folder} is not a suite: it holds no {CARD}. Give the folder that `probe-kit suite build`, "
            "`suite from-csv` or `suite convert` wrote."
        )
    try:
        card = parse_line(read_regular(path), CARD)
    except OSError as problem:
        return [error("E01", CARD, str(problem.strerror))]
    if isinstance(card, Finding):
        return [card]
    return list(check_schema(card, CARD)) or list(check_card(card)) or card


def _read_items(folder: Path) -> tuple[tuple[Item, ...], list[Finding]]:
    path = folder / METADATA
    if not path.is_file():
        return (), [error("E01", METADATA, "the file is missing")]
    try:
        lines = read_regular(path).splitlines()
    except OSError as problem:
        return (), [error("E01", METADATA, str(problem.strerror))]
    items, findings = [], []
    lines_of: dict[str, list[int]] = {}
    for number, line in enumerate(lines, start=1):
        where = f"{METADATA}:{number}"
        if number > MOST_ITEMS:
            findings.append(error("E01", where, f"more than {MOST_ITEMS:,} items; split the suite"))
            break
        record = parse_line(line, where)
        if isinstance(record, Finding):
            findings.append(record)
            continue
        wrong = list(check_schema(record, where)) or list(check_record(record, where))
        findings += wrong
        if not wrong:
            items.append(Item.from_json(record, folder))
            lines_of.setdefault(record["item_id"], []).append(number)
    return tuple(items), findings + list(unique_ids(lines_of))
