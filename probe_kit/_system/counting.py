"""Numbers of things and lists of names in words."""

from collections.abc import Collection, Sequence


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is one: `1 table`, `2 tables`, `3,440 categories`.

    The noun is in the singular. It may have words in front, such as `independent group`.
    """
    if number == 1:
        return f"1 {noun}"
    ends_in_y = noun.endswith("y") and noun[-2:-1] not in "aeiou"
    return f"{number:,} {noun[:-1]}ies" if ends_in_y else f"{number:,} {noun}s"


def spanned(numbers: Collection[int]) -> str:
    """Return the smallest and the largest of some numbers: `3`, `3 to 7`."""
    least, most = min(numbers), max(numbers)
    return f"{least}" if least == most else f"{least} to {most}"


def enumerated(names: Sequence[str]) -> str:
    """Return names as a sentence lists them: `a`, `a and b`, `a, b and c`."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
