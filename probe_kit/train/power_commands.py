"""`probe-kit power`: how many items are needed, and what so many can show."""

from dataclasses import asdict
from math import isfinite, nan
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit._terminal.console import err, out, print_json, split, whole_number
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from probe_kit.train.power import Power

MOST_ITEMS = 100_000


def power(
    items: Annotated[str, typer.Option(help="Comma-separated numbers of items per category.")] = "24,60,150,300",
    signal: Annotated[
        str, typer.Option(help="Comma-separated signals: points of accuracy above chance, in %.")
    ] = "10,15,25",
    sites: Annotated[int, typer.Option(help="Sites among which the best is looked for.", min=1, max=10_000)] = 19,
    wanted: Annotated[
        float | None,
        typer.Option("--power", help="Instead: the fewest items that see each so often, in %.", min=1, max=99.9),
    ] = None,
    width: Annotated[
        float | None, typer.Option(help="Instead: items for an SR interval so wide, in points.", min=0.1, max=100)
    ] = None,
    draws: Annotated[int, typer.Option(help="Simulated experiments per number.", min=20, max=100_000)] = 200,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
) -> None:
    """How many items do I need? Power of probes against chance, binding and a twin, by simulation.

    Assumes two items and four episodes per group, neighbouring sites correlated 0.9, and controls at chance.
    """
    from probe_kit.train.power import items_for_width, items_needed, simulate

    for name, value in (("--power", wanted), ("--width", width)):
        if value is not None and not isfinite(value):
            raise UsageError(f"{name} is {value}; expected a number")
    if width is not None and wanted is not None:
        raise UsageError("--power and --width are two questions; ask them one after the other")
    counts = [_whole(part) for part in split(items) or ()]
    signals = [_points(part) for part in split(signal) or ()]
    if width is not None:
        needed = items_for_width(width / 100)
        print_json({"width": width, "items": needed}) if as_json else out.print(f"{needed} items per category")
        return
    with err.status("simulating"):
        if wanted is not None:
            fewest = {above: items_needed(above, wanted / 100, counts, sites, draws) for above in signals}
        else:
            found = [simulate(count, above, sites, draws) for count in counts for above in signals]
    if wanted is not None:
        if as_json:
            print_json([{"above": above, "items": count} for above, count in fewest.items()])
        for above, count in fewest.items() if not as_json else ():
            answer = f"more than {max(counts)}" if count is None else count
            out.print(f"{100 * above:g} points above chance, seen in {wanted:g} %: {answer} items per category")
    elif as_json:
        print_json([asdict(one) for one in found])
    else:
        _print(found)


def _print(found: "list[Power]") -> None:
    from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable
    from probe_kit.statistics.significance import detectable

    headings = (
        "signal, points",
        "against chance %",
        "against binding %",
        "against a twin %",
        "red control from %",
    )
    rows = [(one.above, one.chance, one.binding, one.twin, detectable(one.items)) for one in found]
    out.print(
        ResponsiveTable(
            title="Power: how often a signal is seen",
            caption="binding and twin at chance; a leaking control of that accuracy is red in 80 % of suites",
            name="items",
            names=tuple(str(one.items) for one in found),
            styles=("",) * len(found),
            parts=(Part("Power", headings, tuple(tuple(Cell(f"{100 * x:.0f}") for x in row) for row in rows)),),
        )
    )


def _whole(text: str) -> int:
    number = whole_number(text)
    if number is None or not 1 <= number <= MOST_ITEMS:
        raise UsageError(f"{text!r} is not a number of items; expected 1 to {MOST_ITEMS}")
    return number


def _points(text: str) -> float:
    try:
        points = float(text)
    except ValueError:
        points = nan
    if not 0 < points <= 50:
        raise UsageError(f"{text!r} is not a number of points above chance; expected up to 50")
    return points / 100
