"""Numbers of things and lists of names in words."""

from collections.abc import Collection, Iterable, Sequence


def plural(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is one: `1 table`, `2 tables`, `3,440 categories`.

    The noun is in the singular. It may have words in front, such as `independent group`.
    """
    if number == 1:
        return f"1 {noun}"
    ends_in_y = noun.endswith("y") and noun[-2:-1] not in "aeiou"
    return f"{number:,} {noun[:-1]}ies" if ends_in_y else f"{number:,} {noun}s"


def describe_range(numbers: Collection[int]) -> str:
    """Return the smallest and the largest of some numbers: `3`, `3 to 7`."""
    least, most = min(numbers), max(numbers)
    return f"{least}" if least == most else f"{least} to {most}"


def ranges_of(numbers: Iterable[int], noun: str, most: int = 8) -> str:
    """Return numbers in ranges behind their noun: `episode 3`, `episodes 0 to 2 and 7`; at most so many ranges."""
    listed = sorted(set(numbers))
    present = set(listed)
    begins = [number for number in listed if number - 1 not in present]
    ends = [number for number in listed if number + 1 not in present]
    ranges = [describe_range((begin, end)) for begin, end in zip(begins, ends, strict=True)]
    more = [f"{len(ranges) - most} further ranges"] if len(ranges) > most else []
    return f"{noun}{'s' * (len(listed) > 1)} {list_names(ranges[:most] + more)}"


def list_names(names: Sequence[str]) -> str:
    """Return names as a sentence lists them: `a`, `a and b`, `a, b and c`."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
