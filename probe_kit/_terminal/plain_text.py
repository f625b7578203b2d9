"""Plain text: what a terminal would obey is shown instead, and local folders are left out of shared pages."""

import re

_BIDI = "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"
UNSAFE = re.compile(f"[\x00-\x08\x0b-\x1f\x7f-\x9f{_BIDI}\u2028\u2029\ufeff\ud800-\udfff]")
"""Control characters but tab and newline, bidirectional marks, foreign line ends, halves of surrogate pairs."""


def terminal_safe(text: str) -> str:
    """`text` without anything that a terminal obeys; what was there shows as a sign of its own, such as ␛."""
    return UNSAFE.sub(_sign, text)


def _sign(match: re.Match[str]) -> str:
    code = ord(match[0])
    return chr(0x2400 + code) if code < 0x20 else "\u2421" if code == 0x7F else "\ufffd"


_QUOTED = re.compile(r"""(["'`])((?:file://)?(?:~|[A-Za-z]:)?[/\\][^"'`\n]*[/\\][^"'`\n]*)\1""")
"""A whole path in quotes, as in JSON; it may hold spaces."""
_PART = r"[\w.@+~%=-]+"
_BARE = re.compile(
    r"(?<![\w:/\\.\]})>…-])(?:file://)?"
    rf"(?:(?:~|[A-Za-z]:)?(?:/{_PART}){{2,}}|~/{_PART}|[A-Za-z]:(?:\\{{1,2}}{_PART})+)/?"
)
"""A path of two parts or more in a sentence."""


def without_places(text: str, places: tuple[str, ...] = ()) -> str:
    """`text` with the last part alone of every absolute path, and of `places`, which may hold spaces."""
    for path in sorted(filter(None, places), key=len, reverse=True):
        text = text.replace(path, _last(path))
    text = _QUOTED.sub(lambda match: f"{match[1]}{_last(match[2])}{match[1]}", text)
    return _BARE.sub(lambda match: _last(match[0]), text)


def _last(path: str) -> str:
    return re.split(r"[/\\]", path.rstrip("/\\"))[-1]
