"""Reading of a source's folder: annotation files, and pictures in one of several places."""

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from probe_kit._system.bounded_json import read_json
from probe_kit.errors import SuiteError
from probe_kit.suite.pictures import WHITE, decode_picture

MARGIN = 0.08  # of the longer side, around trimmed art
MOST_BYTES = 1 << 30
"""Of annotations; the instances of COCO have 350 MB."""
_TRIM_STEP = 12  # levels that ink differs from white


def read_annotations(path: Path, source: str, remedy: str, kind: type = dict) -> Any:
    """The JSON value of `kind` in a file. Raises SuiteError naming source, file and remedy."""
    return read_json(path, SuiteError, f"{remedy} It is needed to convert {source}.", MOST_BYTES, kind)


def first_existing(tried: Sequence[Path], source: str, record: str, remedy: str) -> Path:
    """The first path that is a file. Raises SuiteError naming the record, what was tried, and the remedy."""
    for path in tried:
        if path.is_file():
            return path
    listed = ", ".join(str(path) for path in dict.fromkeys(tried))
    raise SuiteError(f"{source}: image not found for {record}: tried {listed}; {remedy}")


def field_of(record: Any, name: str, kind: type, source: str, where: str) -> Any:
    """A field of a record. Raises SuiteError if it is missing or of another type."""
    value = record.get(name) if isinstance(record, dict) else None
    if not isinstance(value, kind):
        raise SuiteError(
            f"{source}: {where}: field {name!r} is {value!r}; expected a {kind.__name__}. "
            "Check that this is the release the converter was made for (docs/suite.md)."
        )
    return value


def by_key[Key, Value](entries: Iterable[tuple[Key, Value, str]], source: str, key: str) -> dict[Key, Value]:
    """The values of (key, value, where) by their key. key: its name, for messages.

    Raises SuiteError naming both records of a key that occurs twice.
    """
    values: dict[Key, Value] = {}
    places: dict[Key, str] = {}
    for name, value, where in entries:
        if name in values:
            raise SuiteError(
                f"{source}: {where}: {key} {name!r} is that of {places[name]} too; expected one record per {key}. "
                "Unpack the release again."
            )
        values[name], places[name] = value, where
    return values


def photo(path: Path) -> partial[Image.Image]:
    """Loads a photograph as it is."""
    return partial(decode_picture, path)


def trimmed_art(path: Path) -> Image.Image:
    """Line art on white without its own margins, square, with one margin for all."""
    return trimmed(decode_picture(path))


def trimmed(image: Image.Image) -> Image.Image:
    """The picture cut to its ink and padded to a white square with a margin of 8 %."""
    ink = (255 - np.asarray(image.convert("RGB"), np.int64)).max(axis=2) > _TRIM_STEP
    rows, columns = np.flatnonzero(ink.any(axis=1)), np.flatnonzero(ink.any(axis=0))
    if not len(rows):
        return image
    cut = image.crop((int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1))
    side = round(max(cut.size) / (1 - 2 * MARGIN))
    square = Image.new("RGB", (side, side), WHITE)
    square.paste(cut, ((side - cut.width) // 2, (side - cut.height) // 2))
    return square
