"""Pairing of concepts: each occurs about equally often, and often enough with its own kind."""

from collections.abc import Callable, Sequence
from dataclasses import asdict

from probe_kit.hashing import sha256_json
from probe_kit.suite.generators.generator import Concept


def spread_pairs[C: Concept](
    concepts: Sequence[C], allowed: Callable[[C, C], bool], most: int | None = None
) -> tuple[tuple[C, C], ...]:
    """Allowed pairs, at most `most`, that use every concept about equally often.

    The concepts stand in a circle, in an order that follows no family; neighbours are paired first, then those
    two places apart, and so on.
    """
    circle = sorted(concepts, key=lambda concept: sha256_json(asdict(concept)))
    size = len(circle)
    pairs = [
        (circle[place], circle[(place + step) % size])
        for step in range(1, size // 2 + 1)
        for place in range(size if 2 * step < size else size // 2)
    ]
    return tuple(pair for pair in pairs if allowed(*pair))[:most]


def half_within[C: Concept](
    concepts: Sequence[C], family: Callable[[C], object], allowed: Callable[[C, C], bool]
) -> tuple[tuple[C, C], ...]:
    """All allowed pairs inside one family, and as many across families.

    Were most pairs mixed, what a family has in common, such as a red ring, would already tell them apart.
    """
    within = spread_pairs(concepts, lambda a, b: family(a) == family(b) and allowed(a, b))
    across = spread_pairs(concepts, lambda a, b: family(a) != family(b) and allowed(a, b), most=len(within))
    return within + across


def none_alike[C: Concept](families: Sequence[set[str]]) -> Callable[[C, C], bool]:
    """A rule that allows two concepts unless their names are together in one of `families` of look-alikes."""
    return lambda one, other: not any({one.name, other.name} <= family for family in families)
