"""The command `probe-kit power`: how many items are needed, and what a number of items can detect."""

from dataclasses import asdict
from math import isfinite, nan
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit._terminal.console import err, out, print_json, split, whole_number
from probe_kit._terminal.options import AsJson
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from probe_kit.train.power import Power

MOST_ITEMS = 100_000
"""The most items that are simulated on request; a search for a goal stops at fewer, `train.power.MOST_ITEMS`."""
INVERSE = "Number of items for a goal"
ITEMS = "24,60,150,300"


def power(
    items: Annotated[
        str | None,
        typer.Option(
            metavar="N,N,…", help="Numbers of items per category, comma-separated. Default: 24,60,150,300."
        ),
    ] = None,
    signal: Annotated[
        str,
        typer.Option(
            metavar="X,X,…",
            help="How far probes lie above chance, in percentage points, comma-separated. "
            "15 is an accuracy of 65 %.",
        ),
    ] = "10,15,25",
    sites: Annotated[
        int,
        typer.Option(
            help="Number of sites, such as layers, that are probed and corrected for.", min=1, max=10_000
        ),
    ] = 19,
    draws: Annotated[
        int, typer.Option(help="Number of simulated experiments per estimate.", min=20, max=100_000)
    ] = 400,
    as_json: AsJson = False,
    goal: Annotated[
        float | None,
        typer.Option(
            "--power",
            help="Find the smallest number of items with this power, in %.",
            min=1,
            max=99.9,
            rich_help_panel=INVERSE,
        ),
    ] = None,
    width: Annotated[
        float | None,
        typer.Option(
            help="Find the number of items for which the 95 % interval of a success rate has this width, in "
            "percentage points.",
            min=0.1,
            max=100,
            rich_help_panel=INVERSE,
        ),
    ] = None,
) -> None:
    """Estimate the power of probes against chance, random-features and an untrained network by simulation.

    Assumes two items and four episodes per group, a correlation of 0.9 between neighbouring sites, and controls at
    chance.
    """
    from probe_kit.statistics.significance import items_for_width
    from probe_kit.train.power import items_needed, simulate

    for name, value in (("--power", goal), ("--width", width)):
        if value is not None and not isfinite(value):
            raise UsageError(f"{name} is {value}; expected a number")
    if width is not None and goal is not None:
        raise UsageError("--power and --width are two questions; ask them one after the other")
    if items is not None and (width is not None or goal is not None):
        raise UsageError("--power and --width look for the number of items themselves; leave --items out")
    counts = [_whole_number_argument(part) for part in split(items or ITEMS) or ()]
    signals = [_points(part) for part in split(signal) or ()]
    if width is not None:
        count = items_for_width(width / 100)
        print_json({"width": width, "items": count}) if as_json else out.print(f"{count} items per category")
        return
    with err.status("simulating"):
        if goal is None:
            powers = [simulate(count, above, sites, draws) for count in counts for above in signals]
        else:
            needed_for = {above: items_needed(above, goal / 100, sites, draws) for above in signals}
    if goal is None:
        print_json([asdict(estimate) for estimate in powers]) if as_json else _print(powers)
    elif as_json:
        print_json([_as_json(above, goal / 100, needed) for above, needed in needed_for.items()])
    else:
        for above, needed in needed_for.items():
            out.print(f"{100 * above:g} points above chance, seen in {goal:g} %: {_answer(needed)}")


def _as_json(above: float, power: float, needed: "tuple[Power, int] | None") -> dict[str, float | None]:
    """Return one answer as plain values: `reached` is the least share of the three tests, `spread` its error."""
    head: dict[str, float | None] = {"above": above, "power": power}
    if needed is None:
        return head | dict.fromkeys(("items", "resolution", "reached", "spread"))
    estimate, resolution = needed
    return head | {
        "items": estimate.items, "resolution": resolution, "reached": estimate.least, "spread": estimate.spread,
    }  # fmt: skip


def _answer(needed: "tuple[Power, int] | None") -> str:
    from probe_kit.train.power import MOST_ITEMS as MOST_SEARCHED

    if needed is None:
        return f"more than {MOST_SEARCHED} items per category"
    estimate, resolution = needed
    return (
        f"{estimate.items} items per category (to {resolution}; simulated there {100 * estimate.least:.0f} % "
        f"± {100 * estimate.spread:.1f}; more --draws narrow it)"
    )


def _print(estimates: "list[Power]") -> None:
    from probe_kit._tables.numbers import percent, whole_percent
    from probe_kit._tables.table import Cell, Cells, Heading, Legend, Table
    from probe_kit.statistics.significance import detectable
    from probe_kit.statistics.sufficiency import ABSENT_BELOW

    headings = (
        "items",
        "signal, points",
        "against chance %",
        "against random-features %",
        "against an untrained network %",
        Heading(
            "absent if nothing %",
            term=f"absent: how often a stream without signal is called absent, below {100 * ABSENT_BELOW:g} %",
        ),
        Heading("± (standard error)", term="±: of the four, the largest, measured over seeds"),
        Heading(
            "leak found from %",
            term="leak found: a control that a leak of the suite brings to this accuracy is red in 80 % of suites",
        ),
    )
    shares = ("above", "chance", "random_features", "untrained", "absent")
    rows: list[Cells] = [
        (
            str(estimate.items),
            *(Cell(getattr(estimate, share), whole_percent) for share in shares),
            Cell(estimate.spread, percent),
            Cell(detectable(estimate.items), whole_percent),
        )
        for estimate in estimates
    ]
    legend = Legend(before=("random-features and the untrained network at chance",))
    out.print(Table.of("Power: how often a signal is seen", headings, rows, legend=legend))


def _whole_number_argument(text: str) -> int:
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
