"""Probe results in sentences: where the best site of each stream decodes the target."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from probe_kit._system.counting import list_names
from probe_kit._system.escaping import terminal_safe
from probe_kit.hooks.contract.sites import label_of
from probe_kit.runs.layout import UNEDITED
from probe_kit.suite.categories import category_of
from probe_kit.train.choices import EVERYWHERE
from probe_kit.train.results.probe_results import ProbeResults, best_sites, exceeded_controls

if TYPE_CHECKING:
    import pandas as pd


def best_sites_findings(results: ProbeResults) -> list[str]:
    """Return a line per reason for leaving out samples or a control, then a line per category and view.

    Between them stands how many episodes come from which condition of a policy server, if it had any.

    The latter lines say where the target can be decoded. For a side they cover the first view alone, and whether
    the pictures alone decode it: no model has to know it then.
    """
    settings = results.settings
    lines = []
    for view, category, rows in _places(results):
        pixels = results.controls.of_category(category).get("pixels") if settings.balanced else None
        by_pictures = ["the pictures alone decode it too"] * (pixels is not None and pixels.above_chance)
        name = category_of(category).title if settings.balanced else settings.target
        if not settings.balanced:
            name = ", ".join(
                [name, *[category] * (settings.categories != (EVERYWHERE,)), *[view] * (len(settings.views) > 1)]
            )
        lines.append((name, "; ".join([*_findings(results, rows), *by_pictures])))
    width = max((len(name) for name, _ in lines), default=0)
    return [
        *_left_out(results),
        *_conditions(results),
        *(f"{name.ljust(width)}  {finding}." for name, finding in lines),
    ]


def _places(results: ProbeResults) -> "Iterator[tuple[str, str, list[pd.Series]]]":
    """Yield view, category and the best sites of each stream; of a side in the first view alone."""
    rows, settings = best_sites(results.scores), results.settings
    for view in settings.views[:1] if settings.balanced else settings.views:
        for category in dict.fromkeys(str(row["category"]) for row in rows):
            yield view, category, [row for row in rows if (row["category"], row["view"]) == (category, view)]


def _left_out(results: ProbeResults) -> list[str]:
    return [
        *(f"left out: {count} {reason}" for reason, count in results.left_out.items()),
        *(f"control {name} was not run: {reason}" for name, reason in results.controls.left_out.items()),
    ]


def _conditions(results: ProbeResults) -> list[str]:
    """Return a line that says how many probed episodes were edited; none without edits."""
    edited = [name for name in results.conditions if name != UNEDITED]
    if not edited:
        return []
    counts = ", ".join(f"{terminal_safe(name)} {count}" for name, count in results.conditions.items())
    return [
        f"episodes by condition: {counts}. The probes read all of them, with the edits of {list_names(edited)}; "
        f"a table of labels of the episodes of {UNEDITED} alone (--labels) leaves the others out"
    ]


def _findings(results: ProbeResults, rows: "Sequence[pd.Series]") -> Iterator[str]:
    """Yield where the target is decodable, the first two streams with their scores, and where it is not shown."""
    decodable: list[str] = []
    open_: dict[str, list[str]] = {}
    for row in rows:
        stream, (_, missed) = f"the {label_of(row['stream'])}", exceeded_controls(results, row)
        score = f"{100 * row['score']:.0f} %" if results.settings.balanced else f"{row['score']:.2f}"
        if remedy := results.remedy(row["category"], row["view"]):
            # Without enough of them nothing can be shown, whatever the network holds.
            open_.setdefault(f"not testable in {{}}: {remedy}", []).append(stream)
        elif missed:
            open_.setdefault(f"not shown in {{}} beyond {list_names(missed)}", []).append(stream)
        else:
            decodable.append(f"{stream} at {score}" if len(decodable) < 2 else stream)
    if decodable:
        yield f"decodable in {list_names(decodable)}"
    for words, streams in open_.items():
        yield words.format(list_names(streams))
