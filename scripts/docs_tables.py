"""The tables of README and docs that come from `docs/demo.json`, each between two comments of its page."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from probe_kit.demo.pipeline import count_agreements

ROOT = Path(__file__).parents[1]
DATA = ROOT / "docs" / "demo.json"
README = ROOT / "README.md"
PAGES = (ROOT / "docs" / "embedded.md",)
TRAINED = "trained"
_BLOCK = re.compile(r"(<!-- from docs/demo.json: (?P<name>[a-z]+) -->\n).*?(<!-- end of it -->)", re.DOTALL)
Row = Mapping[str, Any]


def filled(page: str, data: Mapping[str, Any]) -> str:
    """The page with the content of every block made anew. Raises KeyError for a block that has no table."""
    return _BLOCK.sub(lambda block: f"{block[1]}\n{_TABLES[block['name']](data)}\n\n{block[3]}", page)


def blocks(page: str) -> list[str]:
    """Names of the blocks a page has."""
    return [block["name"] for block in _BLOCK.finditer(page)]


def trained_table(data: Mapping[str, Any]) -> str:
    """What the demo prints of the trained policy, a row per category."""
    rows = _of(data["demo"], TRAINED)
    rate = f"SR % (Δ {_span(rows, 'chance_margin')})"
    heading = ("demo", "items", rate, "backbone % [95 %]", "action %", "retention [95 %]")
    lines = [(category, str(row["items"]), *cells) for row in rows for category, *cells in [_cells(row)]]
    return _table(heading, lines)


def organisms_table(data: Mapping[str, Any]) -> str:
    """The verdicts on all organisms; those of untrained ones in a line each, since nothing is to be seen."""
    heading = ("policy", "category", "expected", "measured", "agreement", "SR %")
    lines: list[tuple[str, ...]] = []
    compared = data["compare"]
    for name in dict.fromkeys(row["organism"] for row in compared["organisms"]):
        rows = _of(compared, name)
        if len({(row["expected"], row["measured"], row["retention"]) for row in rows}) == 1 < len(rows):
            lines.append(_with_verdict(rows, f"the same {len(rows)}"))
        else:
            lines += [_with_verdict([row], row["category"].capitalize()) for row in rows]
    agreements = count_agreements([row["agreement"] for row in compared["organisms"]])
    margin = _span(compared["organisms"], "chance_margin")
    episodes = 2 * compared["organisms"][0]["items"]
    note = (
        f"{episodes} episodes per category, Δ of {margin} points, {compared['permutations']} "
        f"permutations: {agreements}."
    )
    return f"{_table(heading, lines)}\n\n{note}"


_TABLES: dict[str, Callable[[Mapping[str, Any]], str]] = {"trained": trained_table, "organisms": organisms_table}


def _of(measured: Mapping[str, Any], organism: str) -> list[Row]:
    rows = [row for row in measured["organisms"] if row["organism"] == organism]
    order = {"color": 0, "shape": 1, "state": 2}
    return sorted(rows, key=lambda row: order.get(row["category"], len(order)))


def _table(heading: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in (heading, ["---"] * len(heading), *lines))


def _cells(row: Row) -> tuple[str, ...]:
    low, high = map(_percent, row["backbone_ci"])
    return (
        row["category"].capitalize(),
        _percent(row["sr"]),
        f"{_percent(row['backbone'])} [{low}, {high}], {_verdict(row)}",
        _percent(row["action"]),
        _retention(row),
    )


def _with_verdict(rows: Sequence[Row], category: str) -> tuple[str, ...]:
    first = rows[0]
    verdicts = (first[key] for key in ("expected", "measured", "agreement"))
    return first["organism"], category, *verdicts, _span(rows, "sr")


def _verdict(row: Row) -> str:
    """What was found in the backbone; unless it is shown, how accurate its best site could be at most."""
    most = "" if row["verdict"] == "shown" else f" (at most {_percent(row['at_most'])})"
    return row["verdict"] + most


def _span(rows: Sequence[Row], name: str) -> str:
    low, high = (_percent(value) for value in (min(row[name] for row in rows), max(row[name] for row in rows)))
    return low if low == high else f"{low} to {high}"


def _percent(share: float | None) -> str:
    """One decimal, none where it is zero."""
    return "n/a" if share is None else f"{100 * share:.1f}".removesuffix(".0")


def _retention(row: Row) -> str:
    """Retention with its interval; n/a where the backbone's signal is not shown."""
    if row["retention"] is None:
        return "n/a"
    limits = row["retention_ci"]
    if None in limits:
        return f"{row['retention']:.2f} [no limits]"
    return f"{row['retention']:.2f} [{limits[0]:.2f}, {limits[1]:.2f}]".replace("-", "−")
