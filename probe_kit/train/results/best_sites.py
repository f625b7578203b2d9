"""The best sites of each category: one table for a terminal, and a sentence per category."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit._system.counting import counted
from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable
from probe_kit.hooks.contract.sites import label_of
from probe_kit.suite.categories import category_of
from probe_kit.train.choices import Target
from probe_kit.train.results.control_scores import RANDOM_FEATURES, UNTRAINED
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.summary import best_sites, site_cells

if TYPE_CHECKING:
    import pandas as pd

_LEGEND = "+: as many other sites tie with it. The accuracy of a chosen site is too high; `retention` corrects it"
_CONTROLS = {"chance": "p_fwe", RANDOM_FEATURES: "exceeds_random_features", UNTRAINED: "exceeds_untrained"}
_TARGETS: dict[Target, str] = {
    "correct": "the side of the correct picture",
    "chosen": "the chosen side",
    "shuffled": "the shuffled side",
}


def best_sites_table(
    fitted: Sequence[ProbeResults], random_weights: bool = False, splits: bool = True
) -> ResponsiveTable:
    """A row per category, stream, view and captured inference. fitted: probes of a run, one per inference."""
    views = dict.fromkeys(view for results in fitted for view in results.settings.views)
    names, cells = [], []
    for results in fitted:
        for view in views:
            for row in _rows(results, view):
                several = [view] * (len(views) > 1) + [f"call {results.settings.call}"] * (len(fitted) > 1)
                names.append(" · ".join([str(row["category"]), *several]))
                cells.append(_cells(row))
    sites = ("best site", "accuracy % [95 %]", "family-wise p", "exceeds", "n", "first iteration %")
    said = [f"view {next(iter(views))}"] * (len(views) == 1)
    said += [f"call {fitted[0].settings.call}"] * (len(fitted) == 1)
    said += ["RANDOM WEIGHTS"] * random_weights
    return ResponsiveTable(
        title=", ".join(["Best site per stream", *said]),
        caption=_LEGEND,
        name="category",
        names=tuple(names),
        styles=("",) * len(names),
        parts=(Part("Best sites", sites, tuple(cells)),),
        splits=splits,
    )


def best_sites_sentences(results: ProbeResults) -> list[str]:
    """One per category, of the first view: in which streams the target can be decoded, or from pictures alone."""
    rows = _rows(results, results.settings.views[0])
    found = []
    for category in dict.fromkeys(str(row["category"]) for row in rows):
        own = [row for row in rows if row["category"] == category]
        name, count = category_of(category).title, own[0]["n"]
        parts = "; ".join(map(_in_stream, own))
        pictures = _from_pictures(results, category)
        found.append(
            f"{name} ({counted(count, 'episode')}): {_TARGETS[results.settings.target]} is {parts}.{pictures}"
        )
    return found


def _from_pictures(results: ProbeResults, category: str) -> str:
    """A sentence where the control `pixels` decodes the target, for no model has to know it then."""
    pixels = results.controls.of_category(category).get("pixels")
    if pixels is None or not pixels.above_chance:
        return ""
    accuracy, low, high = (f"{100 * share:.0f}" for share in (pixels.accuracy, *pixels.ci))
    return f" The pictures alone decode it too ({accuracy} %, {low} to {high})."


def _rows(results: ProbeResults, view: str) -> "list[pd.Series]":
    peaks = best_sites(results.scores).sort_values(["category", "stream"], kind="stable")
    return [row for _, row in peaks[peaks["view"] == view].iterrows()]


def _in_stream(row: "pd.Series") -> str:
    accuracy, low, high = (f"{100 * row[name]:.0f}" for name in ("accuracy", "ci_low", "ci_high"))
    where, numbers = f"in the {label_of(row['stream'])}", f"({accuracy} %, {low} to {high})"
    shown, missed = _exceeded(row)
    if "chance" not in (*shown, *missed):
        return f"not tested {where} {numbers}: fit with permutations"
    if missed:
        return f"not shown {where} beyond {' and '.join(missed)} {numbers}"
    return f"decodable {where} at {row['site']} {numbers}"


def _cells(row: "pd.Series") -> tuple[Cell, ...]:
    site, accuracy, first, p = site_cells(row)
    shown, missed = _exceeded(row)
    exceeds = (
        "; ".join(filter(None, [", ".join(shown), f"not shown: {', '.join(missed)}" if missed else ""])) or "–"
    )
    return tuple(map(Cell, (site, accuracy, p, exceeds, str(row["n"]), first)))


def _exceeded(row: "pd.Series") -> tuple[list[str], list[str]]:
    """The controls that a site is shown to exceed, and those that it is not shown to exceed."""
    from pandas import isna

    from probe_kit.statistics.significance import SIGNIFICANCE

    found = {name: row[column] for name, column in _CONTROLS.items() if not isna(row[column])}
    if "chance" in found:
        found["chance"] = found["chance"] < SIGNIFICANCE
    return [name for name in found if found[name]], [name for name in found if not found[name]]
