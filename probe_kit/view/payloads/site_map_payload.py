"""The payload of a layer × iteration map: scores of every site of one category, and its episodes' log-odds."""

from collections.abc import Hashable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from probe_kit._tables.numbers import p_text, percent, with_limits
from probe_kit.suite.categories import category_of
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.view.frozen_probes import Values, decisions_toward_correct
from probe_kit.view.payloads.coding import pack_log_odds, rounded
from probe_kit.view.viewed_run import ViewedRun

NULL_SHARE = 0.95
"""Share of accuracies under label permutation that lie below the quantile that is shown."""
HEADINGS = (
    "accuracy % [95 %]",
    "p of this site",
    "p, family-wise",
    "permuted labels, 95 % below %",
    "random labels %",
    "verdict",
)


def site_map_payload(viewed: ViewedRun, category: str) -> dict[str, Any]:
    """Scores by site, spelt as in the tables; log-odds (S, E) packed, toward the correct side.

    `rows`: the place of each of the E episodes among those of the run. `refitted`: the same scores of probes that
    were fitted to later inferences, by inference. Raises KeyError for a category without probes.
    """
    results, curve = viewed.results, viewed.curve(category)
    if results is None or curve is None:
        raise KeyError(category)
    scores = _scores(results, category, viewed.view)
    rows, log_odds = _first_log_odds(viewed, category)
    quantiles = pd.DataFrame(curve.null.T).quantile(NULL_SHARE).tolist() if curve.null.shape[1] else []
    return {
        "category": category,
        "title": category_of(category).title,
        "view": viewed.view,
        "n": int(scores["n"].iloc[0]),
        "items": int(scores["items"].iloc[0]),
        "groups": int(scores["groups"].iloc[0]),
        "headings": HEADINGS,
        "cells": [
            _cells(row, quantiles[index] if quantiles else None)
            for index, row in enumerate(scores.to_dict("records"))
        ],
        **_shades(scores),
        "rows": rows,
        "log_odds": pack_log_odds(log_odds),
        "refitted": {
            str(call): _shades(_scores(other, category, viewed.view))
            for call, other in viewed.refitted.items()
            if call != results.settings.call and (category, viewed.view) in other.curves
        },
    }


def target_map_payload(viewed: ViewedRun, number: int) -> dict[str, Any]:
    """Return the scores by site of a target that was probed. Raises KeyError for a number without one."""
    if number >= len(viewed.target_curves):
        raise KeyError(number)
    results, category = viewed.target_curves[number]
    view = results.settings.views[0]
    scores = _scores(results, category, view)
    metric = str(scores["metric"].iloc[0])
    return {
        "target": results.settings.target,
        "category": category,
        "view": view,
        "metric": metric,
        "n": int(scores["n"].iloc[0]),
        "groups": int(scores["groups"].iloc[0]),
        "sites": [
            {"name": str(site), "stream": site.stream, "layer": site.layer, "iteration": site.iteration}
            for site in results.curves[category, view].sites
        ],
        "headings": (f"{metric} [95 %]", "chance", "p of this site", "p, family-wise", "verdict"),
        "cells": [_target_cells(row) for row in scores.to_dict("records")],
        "score": [rounded(value) for value in scores["score"]],
        "chance": [rounded(value) for value in scores["chance"]],
        "signal": [bool(value) for value in scores["signal"]],
    }


def _target_cells(row: Mapping[Hashable, Any]) -> list[str]:
    limits = _or_none(row["ci_low"]), _or_none(row["ci_high"])
    return [
        with_limits(_or_none(row["score"]), limits, "{:.2f}".format),
        "–" if row["chance"] != row["chance"] else f"{row['chance']:.2f}",
        p_text(_or_none(row["p"])),
        p_text(_or_none(row["p_fwe"])),
        "signal" if row["signal"] else "no signal shown",
    ]


def _first_log_odds(viewed: ViewedRun, category: str) -> tuple[list[int], Values]:
    """Rows of the E episodes that the probes of a category read, and (S, E) log-odds."""
    probes = viewed.probes[category]
    if viewed.is_lent:
        rows = np.flatnonzero(viewed.run.episodes["category"] == category).tolist()
        return rows, np.stack([probes.first(row) for row in rows], axis=-1)
    curve = probes.curve
    positions = {str(name): index for index, name in enumerate(viewed.run.episodes["episode_id"])}
    columns = [index for index, name in enumerate(curve.episodes.tolist()) if name in positions]
    rows = [positions[name] for name in curve.episodes[columns].tolist()]
    every = viewed.run.episodes["side_correct"].astype(str).tolist()
    return rows, decisions_toward_correct(curve, columns, [every[row] for row in rows])


def _scores(results: ProbeResults, category: str, view: str | None) -> pd.DataFrame:
    scores = results.scores
    return scores[(scores["category"] == category) & (scores["view"] == view)]


def _shades(scores: pd.DataFrame) -> dict[str, Any]:
    return {
        "accuracy": [rounded(value) for value in scores["accuracy"]],
        "signal": [bool(value) for value in scores["signal"]],
    }


def _cells(row: Mapping[Hashable, Any], quantile: float | None) -> list[str]:
    limits = _or_none(row["ci_low"]), _or_none(row["ci_high"])
    return [
        with_limits(_or_none(row["accuracy"]), limits, percent),
        p_text(_or_none(row["p"])),
        p_text(_or_none(row["p_fwe"])),
        percent(quantile),
        percent(_or_none(row["control_accuracy"])),
        "signal" if row["signal"] else "no signal shown",
    ]


def _or_none(value: float) -> float | None:
    return None if value != value else float(value)
