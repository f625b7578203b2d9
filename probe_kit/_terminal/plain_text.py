"""Sanitising of foreign text: escape sequences and control characters are shown, not executed."""

import re

_BIDI = "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"
UNSAFE = re.compile(f"[\x00-\x08\x0b-\x1f\x7f-\x9f{_BIDI}\u2028\u2029\ufeff\ud800-\udfff]")
"""Control characters but tab and newline, bidirectional marks, foreign line ends, halves of surrogate pairs."""


def terminal_safe(text: str) -> str:
    """`text` without anything that a terminal obeys; what was there shows as a sign of its own, such as ␛."""
    return UNSAFE.sub(_sign, text)


def _sign(found: re.Match[str]) -> str:
    code = ord(found[0])
    return chr(0x2400 + code) if code < 0x20 else "\u2421" if code == 0x7F else "\ufffd"
