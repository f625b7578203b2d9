"""Holm's correction over all tests of one table."""

from collections.abc import Callable, Hashable, Sequence

from probe_kit.statistics.paired_tests import holm


def corrected[Row](
    rows: Sequence[Row],
    p: Callable[[Row], float | None],
    summary: Callable[[Row], bool] = lambda _: False,
    test: Callable[[Row], Hashable] | None = None,
) -> list[float | None]:
    """The corrected p of every row, in order; None where it has none.

    summary: whether a row is over several categories; such rows are a family of their own. test: what a row
    tests; several rows of one test, such as the views of one success rate, count once. By default each its own.
    """
    named = list(range(len(rows))) if test is None else [test(row) for row in rows]
    found: dict[Hashable, float | None] = {}
    for over_all in (False, True):
        family = {name: p(row) for name, row in zip(named, rows, strict=True) if summary(row) == over_all}
        found |= zip(family, holm(list(family.values())), strict=True)
    return [found[name] for name in named]
