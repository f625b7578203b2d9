"""Parsing of untrusted JSON, with limits on size and depth; NaN and infinite numbers are refused."""

import gzip
import json
import re
from codecs import BOM_UTF8
from math import isfinite
from pathlib import Path
from typing import Any

from probe_kit._system.bounded_files import MOST_BYTES, open_regular, read_regular
from probe_kit.errors import ProbeKitError

MOST_VALUES = 1 << 25
"""Values of one text; in Python each takes 8 to 80 bytes, however short it is written."""
_HALF = re.compile(r"\\u[dD][89a-fA-F]")
"""An escape of half a surrogate pair, whose other half may be missing."""


def parse_json(content: bytes | str, **options: Any) -> Any:
    """The value. options: hooks of `json.loads`.

    Raises ValueError for text that is not UTF-8 or JSON, nests too deeply, has half characters, repeats a key, or
    may hold more than `MOST_VALUES` values.
    """
    try:
        text = content.decode("utf-8-sig") if isinstance(content, bytes) else content
        # Every value but the first comes after one of these signs, which texts may hold as well.
        if len(text) > MOST_VALUES and (most := sum(map(text.count, ",[{"))) > MOST_VALUES:
            raise ValueError(f"it may hold {most:,} values; expected at most {MOST_VALUES:,}")
        value = json.loads(text, object_pairs_hook=_distinct, **options)
        # Half a pair cannot be encoded; of a text without such escapes that is known without writing it again.
        (json.dumps(value, ensure_ascii=False) if _HALF.search(text) else text).encode()
    except RecursionError:
        raise ValueError("it nests too deeply") from None
    except UnicodeEncodeError:
        raise ValueError("it holds half a surrogate pair, which is not a character") from None
    return value


def parse_strict_json(content: bytes) -> Any:
    """The value of JSON that probe_kit wrote itself.

    Raises ValueError for what `parse_json` refuses, for a byte order mark, and for a number that is not finite.
    """
    if content.startswith(BOM_UTF8):
        raise ValueError("it begins with a byte order mark")
    return parse_json(content, parse_constant=_finite, parse_float=_finite)


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it names the key {next(name for name in names if names.count(name) > 1)!r} twice")
    return content


def _finite(number: str) -> float:
    value = float(number)
    if not isfinite(value):
        raise ValueError(f"it holds {number[:20]}, which is not a finite number")
    return value


def load_json(file: Path, most: int = MOST_BYTES) -> Any:
    """Return the value in a file of at most `most` bytes.

    Raises OSError as `read_regular` does, ValueError as `parse_json` does.
    """
    return parse_json(read_regular(file, most))


def load_gzipped_json(file: Path) -> Any:
    """Return the value in a gzipped file of at most `MOST_BYTES` unpacked bytes. Raises as `load_json`."""
    with open_regular(file) as packed, gzip.open(packed) as unpacked:
        content = unpacked.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise ValueError(f"it unpacks to more than {MOST_BYTES / 1e6:,.0f} MB")
    return parse_json(content)


_KINDS: dict[type, str] = {dict: "an object", list: "a list"}


def read_json(
    file: Path, raises: type[ProbeKitError], advice: str, most: int = MOST_BYTES, kind: type = object
) -> Any:
    """The value in a file. most: bytes. kind: `dict` or `list`, if it must be one.

    Raises `raises` with `advice` if the file is missing, too large, unreadable, no JSON, or of another kind.
    """
    try:
        value = load_json(file, most)
    except FileNotFoundError:
        raise raises(f"{file} is missing. {advice}") from None
    except OSError as error:
        raise raises(f"{file} cannot be read ({error.strerror}). {advice}") from error
    except ValueError as error:
        raise raises(f"{file} is not JSON ({error}). {advice}") from error
    if not isinstance(value, kind):
        raise raises(f"{file} holds a JSON {type(value).__name__}; expected {_KINDS[kind]}. {advice}")
    return value


def read_json_object(file: Path, raises: type[ProbeKitError], advice: str) -> dict[str, Any]:
    """The object in a file; raises as `read_json` does."""
    value: dict[str, Any] = read_json(file, raises, advice, kind=dict)
    return value
