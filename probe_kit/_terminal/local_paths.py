"""Removal of local folder names from pages that users share."""

import re

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
    for place in sorted(filter(None, places), key=len, reverse=True):
        text = text.replace(place, _last(place))
    text = _QUOTED.sub(lambda found: f"{found[1]}{_last(found[2])}{found[1]}", text)
    return _BARE.sub(lambda found: _last(found[0]), text)


def _last(path: str) -> str:
    return re.split(r"[/\\]", path.rstrip("/\\"))[-1]
