"""Numbers that stay on one line with their units, their signs and their intervals, wherever text is wrapped."""

import re

NO_BREAK_SPACE = "\u00a0"
_UNITS = (
    "%|‰|°C?|[kMGT]i?B|[kMG]?Hz|[nµmck]?m|[nµm]?s|min|h|d|px|fps|dB"
    "|bytes?|seconds?|minutes?|hours?|days?|percent|points?"
)
"""Signs of units, and the words that are written behind a number in place of them."""
_NUMBER = r"[-−+]?\d[\d,.]*"
_TOGETHER = re.compile(
    rf"(?<=\d) (?=(?:{_UNITS})(?![\w/])|(?:CPU|GPU)-(?:second|hour|day)s?\b)"  # 65 %
    r"| (?=[%‰])"  # success %
    r"|(?<=[±≤≥≈]) (?=[-−+]?[\d.])|(?<=\bp) (?=[=<>≤≥≈] \.?\d)|(?<=\bp [=<>]) (?=\.?\d)"  # p = 0.03
    rf"|(?<=,) (?=(?:{_NUMBER}|[-−]?∞)(?: %)?\])"  # [0.55, 0.70]
)


def keep_numbers_whole(text: str, space: str = NO_BREAK_SPACE) -> str:
    """Return `text` with `space` in place of blanks within a number and its unit, `p = 0.03` or `[0.55, 0.70]`.

    A browser breaks no line at the default. rich does, so the console passes a sign that is no blank.
    """
    return _TOGETHER.sub(space, text)
