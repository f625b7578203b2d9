"""Probe results for a terminal: the best site of each stream as a table, and in sentences."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from probe_kit._system.counting import enumerated
from probe_kit._tables.numbers import p_text
from probe_kit._tables.table import Table
from probe_kit.hooks.contract.sites import label_of
from probe_kit.suite.categories import category_of
from probe_kit.train.choices import EVERYWHERE
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.probe_results import ProbeResults, best_sites, score_text, site_cells

if TYPE_CHECKING:
    import pandas as pd

_TIES = "+: as many other sites tie with it"
_LEGEND = "the score of a chosen site is too high"
_OF_SIDE = "; `retention` corrects it"
_OF_LABEL = ". Chance: mean score of this site with exchanged labels"


# -- the table of a terminal -----------------------------------------------------------------------------------


def best_sites_table(fitted: Sequence[ProbeResults], splits: bool = True) -> Table:
    """Return a row per category, stream, view and captured inference, and per control of a target that is no side.

    fitted: probes of one target in a run, one per inference. Controls of a side are in the table with `splits`.
    """
    first, several_calls = fitted[0].settings, len(fitted) > 1
    several_views, metric = len(first.views) > 1, "accuracy %" if first.is_side else METRICS[first.task]
    rows: list[tuple[str, ...]] = []
    for results in fitted:
        call = [f"call {results.settings.call}"] * several_calls
        for row in _best(results):
            view = [str(row["view"])] * several_views
            name = " · ".join([_name(results, row["category"], row["stream"]), *view, *call])
            met, missed = _exceeded(results, row)
            parts = [", ".join(met)] * bool(met) + [f"not shown: {', '.join(missed)}"] * bool(missed)
            begin = score_text(row["first"], first.is_side)
            rows.append((name, *site_cells(row, first.is_side), "; ".join(parts) or "–", str(row["n"]), begin))
        for control in results.controls.scores if splits or not first.is_side else ():
            view = [control.view] * (several_views and bool(control.view))
            where = _name(results, control.category, control.stream)
            name = " · ".join(filter(None, [f"control {control.name}", where, *view, *call]))
            score, low, high, chance = (
                score_text(value, first.is_side) for value in (control.score, *control.ci, control.chance)
            )
            p = "–" if control.p is None else f"{p_text(control.p)} (this control alone)"
            rows.append((name, "", f"{score} [{low}, {high}]", chance, p, "", str(control.n), ""))
    headings = (
        "category" if first.is_side else "stream",
        "best site",
        f"{metric} [95 %]",
        "chance",
        "family-wise p",
        "exceeds",
        "n",
        "first iteration",
    )
    notes = [_TIES, _LEGEND + (_OF_SIDE if first.is_side else _OF_LABEL)]
    overflow = "split" if splits else "leave out"
    return Table.of(", ".join(_title(fitted, several_views)), headings, rows, notes=notes, overflow=overflow)


def _title(fitted: Sequence[ProbeResults], several_views: bool) -> Iterator[str]:
    settings = fitted[0].settings
    yield f"{settings.target}: best site per stream" if not settings.is_side else "Best site per stream"
    if not settings.is_side:
        yield settings.task
    if not several_views:
        yield f"view {settings.views[0]}"
    if len(fitted) == 1 and settings.window == 1:
        yield f"call {settings.call}"
    if settings.align_to:
        yield f"from {settings.align_to.partition('#')[0]} on"
    if settings.random_weights:
        yield "RANDOM WEIGHTS"


def _name(results: ProbeResults, category: str, stream: str) -> str:
    """Return the category, and for a target that is no side the stream."""
    if results.settings.is_side:
        return str(category)  # as --categories takes it
    pooled = results.settings.categories == (EVERYWHERE,)
    return " · ".join(filter(None, ["" if pooled else str(category), label_of(stream) if stream else ""]))


def _best(results: ProbeResults) -> "list[pd.Series]":
    return best_sites(results.scores, results.settings.is_side)


def _exceeded(results: ProbeResults, row: "pd.Series") -> tuple[list[str], list[str]]:
    """The controls that a site is shown to exceed, and those that it is not shown to exceed; chance among them."""
    exceeds = results.controls.exceeds(row["category"], row["view"], row["site"], row["p_fwe"])
    return [name for name in exceeds if exceeds[name]], [name for name in exceeds if exceeds[name] is False]


# -- sentences -------------------------------------------------------------------------------------------------


def best_sites_findings(results: ProbeResults) -> list[str]:
    """Return what was left out, then where the target can be decoded: a line per category and view.

    Of a side the first view alone, and whether the pictures alone decode it: no model has to know it then.
    """
    settings = results.settings
    lines = []
    for view, category, rows in _places(results):
        pixels = results.controls.of_category(category).get("pixels") if settings.is_side else None
        by_pictures = ["the pictures alone decode it too"] * (pixels is not None and pixels.above_chance)
        name = category_of(category).title if settings.is_side else settings.target
        if not settings.is_side:
            name = ", ".join(
                [name, *[category] * (settings.categories != (EVERYWHERE,)), *[view] * (len(settings.views) > 1)]
            )
        lines.append((name, "; ".join([*_findings(results, rows), *by_pictures])))
    width = max((len(name) for name, _ in lines), default=0)
    return [*_left_out(results), *(f"{name.ljust(width)}  {finding}." for name, finding in lines)]


def _places(results: ProbeResults) -> "Iterator[tuple[str, str, list[pd.Series]]]":
    """Yield view, category and the best sites of each stream; of a side in the first view alone."""
    rows, settings = _best(results), results.settings
    for view in settings.views[:1] if settings.is_side else settings.views:
        for category in dict.fromkeys(str(row["category"]) for row in rows):
            yield view, category, [row for row in rows if (row["category"], row["view"]) == (category, view)]


def _left_out(results: ProbeResults) -> list[str]:
    return [
        *(f"left out: {count} {reason}" for reason, count in results.left_out.items()),
        *(f"control {name} was not run: {reason}" for name, reason in results.controls.left_out.items()),
    ]


def _findings(results: ProbeResults, rows: "Sequence[pd.Series]") -> Iterator[str]:
    """Yield where the target is decodable, the first two streams with their scores, and where it is not shown."""
    decodable: list[str] = []
    open_: dict[str, list[str]] = {}
    for row in rows:
        stream, (_, missed) = f"the {label_of(row['stream'])}", _exceeded(results, row)
        score = f"{100 * row['score']:.0f} %" if results.settings.is_side else f"{row['score']:.2f}"
        if remedy := results.remedy(row["category"], row["view"]):
            # Without enough of them nothing can be shown, whatever the network holds.
            open_.setdefault(f"not testable in {{}}: {remedy}", []).append(stream)
        elif missed:
            open_.setdefault(f"not shown in {{}} beyond {enumerated(missed)}", []).append(stream)
        else:
            decodable.append(f"{stream} at {score}" if len(decodable) < 2 else stream)
    if decodable:
        yield f"decodable in {enumerated(decodable)}"
    for words, streams in open_.items():
        yield words.format(enumerated(streams))
