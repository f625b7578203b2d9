"""The payload of a run: what it is, its streams and sites, its rows of the table, its settings."""

from collections.abc import Mapping, Sequence
from typing import Any

from probe_kit.env.scoring import RULES
from probe_kit.retention import RetentionRow
from probe_kit.retention.columns.columns import (
    ACCURACY,
    ACTION,
    ACTION_VERDICT,
    BACKBONE,
    BACKBONE_VERDICT,
    RETENTION,
    SR,
    USED,
    Column,
)
from probe_kit.retention.estimators import Limits
from probe_kit.retention.rows.row import StreamPart
from probe_kit.runs.growth import flat_settings
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.suite.categories import category_of
from probe_kit.view.payloads.coding import rounded
from probe_kit.view.viewed_run import ViewedRun

SCENE_VIEWS = ("overview", "map", "episodes", "compare", "questions", "results")
OTHER_VIEWS = ("overview", "map", "episodes")
"""Views of a run of the scene, and of one without sides: its overview holds the results."""
_PROBED = (BACKBONE, BACKBONE_VERDICT, ACTION, ACTION_VERDICT, RETENTION)


def run_payload(viewed: ViewedRun, page_runs: Sequence[ViewedRun] = ()) -> dict[str, Any]:
    """Return everything that is said once per run. page_runs: of the page, of which VLM runs give a column."""
    run, results = viewed.run, viewed.results
    certificate = run.certificate if len(run.episodes) else {}
    return {
        "key": viewed.key,
        "label": run.label,
        "model": run.model,
        "suite": run.suite,
        "wording": run.wording,
        "random_weights": run.random_weights,
        "weights": run.weights_sha256,
        "planned": run.planned,
        "committed": len(run.episodes),
        "failed": len(run.failed),
        "answers": viewed.answers,
        "sides": viewed.has_sides,
        "views": list(SCENE_VIEWS if viewed.has_sides else OTHER_VIEWS),
        "targets": [
            {"target": results.settings.target, "category": category}
            for results, category in (viewed.target_curves if len(run.episodes) else ())
        ],
        "captured_calls": run.captured_calls,
        "probes": None if results is None else results.key,
        "probes_of": viewed.lender.run.label if viewed.lender is not None and viewed.is_lent else None,
        "view": viewed.view,
        "target": None if results is None else results.settings.target,
        "refitted": sorted(call for call in viewed.refitted if call),
        "chance": CHANCE,
        "streams": [
            {"name": name, "label": stream.label, "part": stream.part} for name, stream in run.streams.items()
        ],
        "sites": [
            {"name": str(site), "stream": site.stream, "layer": site.layer, "iteration": site.iteration}
            for site in viewed.sites
        ],
        "categories": [
            {"name": name, "title": category_of(name).title, "best": best_places(viewed, name)}
            for name in viewed.categories
        ],
        "scene": _scene(run.settings.get("scene")),
        "rules": dict(RULES),
        "certificate": {
            "same_actions": certificate.get("hooks_on_equals_hooks_off"),
            "device": certificate.get("device"),
        },
        "table": _table(viewed, [other for other in page_runs if other.answers and other.run.suite == run.suite]),
        "notes": list(viewed.table.notes) if len(run.episodes) and viewed.has_sides else [],
        "settings": {name: str(value) for name, value in flat_settings(run.settings).items()},
        "stamp": run.stamp,
    }


def best_places(viewed: ViewedRun, category: str) -> dict[str, Any]:
    """Return by part the index of the best site among all, and whether it has signal; None without probes."""
    row = viewed.probed_rows.get(category) if viewed.has_sides else None
    if row is None or viewed.curve(category) is None:
        return {"backbone": None, "action": None}
    names = [str(site) for site in viewed.sites]
    parts: dict[str, StreamPart] = {"backbone": row.backbone, "action": row.action}
    return {
        name: None if part.site is None else {"site": names.index(part.site), "signal": part.has_signal}
        for name, part in parts.items()
    }


def _scene(scene: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if scene is None:
        return None
    return {name: scene[name] for name in ("tile_side", "epsilon", "max_steps", "tile_left", "tile_right", "home")}


def _table(viewed: ViewedRun, vlm_runs: Sequence[ViewedRun]) -> dict[str, Any]:
    """Headings, a row per category and their mean, as the retention table spells them."""
    rows = [*viewed.rows.values(), viewed.mean] if len(viewed.run.episodes) and viewed.has_sides else []
    columns: tuple[Column, ...] = (ACCURACY if viewed.answers else SR,)
    if any(row.backbone.site or row.action.site for row in rows):
        columns += _PROBED
    if any(row.image_swap.follow_rate is not None for row in rows):
        columns += (USED,)
    vlm = vlm_runs[0] if vlm_runs and not viewed.answers else None
    return {
        "columns": [
            *([] if vlm is None else [{"key": "vlm", "heading": ACCURACY.heading, "help": ACCURACY.help}]),
            *({"key": column.key, "heading": column.heading, "help": column.help} for column in columns),
        ],
        "vlm": None if vlm is None else vlm.run.label,
        "vlm_key": None if vlm is None else vlm.key,
        "rows": [
            {
                "category": row.category,
                "cells": [
                    *([] if vlm is None else [_vlm_cell(vlm, row.category)]),
                    *(_cell(column, row) for column in columns),
                ],
            }
            for row in rows
        ],
    }


def _vlm_cell(vlm: ViewedRun, category: str) -> dict[str, Any]:
    row = vlm.rows.get(category) or (vlm.mean if category == vlm.mean.category else None)
    return {"text": "–"} if row is None else _cell(ACCURACY, row)


def _cell(column: Column, row: RetentionRow) -> dict[str, Any]:
    """The text of the table, and value and interval where the page draws them."""
    drawn: dict[str, tuple[float | None, Limits | None]] = {
        SR.key: (row.success.sr, row.success.ci),
        BACKBONE.key: (row.backbone.score, row.backbone.ci),
        ACTION.key: (row.action.score, row.action.ci),
    }
    value, limits = drawn.get(column.key, (None, None))
    cell: dict[str, Any] = {"text": column.text(row)}
    if value is not None:
        cell["value"] = rounded(value)
        cell["limits"] = None if limits is None else [rounded(limit) for limit in limits]
    return cell
