"""Canonical JSON and hashes, from which suites, settings and seeds are named."""

import hashlib
import json
import unicodedata
from typing import Any


def canonical_json(value: Any) -> str:
    """Return the one spelling of a value: sorted keys, no spaces, NFC, no NaN."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return unicodedata.normalize("NFC", text)


def sha256_text(text: str) -> str:
    """Return the hex sha256 of the UTF-8 bytes of `text`."""
    return hashlib.sha256(text.encode()).hexdigest()


def sha256_json(value: Any) -> str:
    """Return the hex sha256 of the canonical JSON of `value`."""
    return sha256_text(canonical_json(value))


def derive_seed(*parts: str | int) -> int:
    """Return a 63-bit seed that depends on the parts alone, never on order of work or worker."""
    return int(sha256_json(list(parts))[:16], 16) >> 1
