"""The payloads of a run, of its site maps and results, coded as scripts that call `put(name, value)`."""

import json
from base64 import b64encode
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from probe_kit._system.escaping import terminal_safe, without_folders
from probe_kit._system.types import Matrix
from probe_kit._tables.numbers import p_text, percent, with_limits
from probe_kit._tables.table import Table, TableRow
from probe_kit.diagnose.diagnosis import load_diagnosis
from probe_kit.diagnose.results import diagnosis_table
from probe_kit.env.scoring import RULES
from probe_kit.errors import RunDamagedError
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.inventory import listed_interventions
from probe_kit.intervene.kinds.knockout import Knockout
from probe_kit.intervene.results import InterventionResult
from probe_kit.intervene.stored import stored_interventions
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
from probe_kit.retention.displays.interventions import cut_curves, measure_of_cuts
from probe_kit.retention.rows.row import StreamPart
from probe_kit.runs.action_errors import action_error_table, compare_actions, why_not_compared
from probe_kit.runs.environment_success import EnvironmentSuccess
from probe_kit.runs.layout import DIAGNOSES, INTERVENTIONS, PROBES
from probe_kit.runs.results import bundle_keys
from probe_kit.runs.writer import flat_settings
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.suite.categories import category_of
from probe_kit.train.results.probe_results import ProbeResults, best_sites_table
from probe_kit.train.results.store import load_results, stored_targets
from probe_kit.train.results.summary import best_sites_findings
from probe_kit.view.viewed_run import ViewedRun, decisions_toward_correct

# Log-odds travel as 16-bit integers: a page of a large run holds millions, and as text each is twice as long.
LOG_ODDS_SCALE = 256
"""Steps per unit of log-odds: the error is below 0.002."""
MISSING = -32768
"""The value in place of a log-odds that does not exist, such as that of an inference the episode did not reach.

The least 16-bit integer, which no rounded log-odds takes: they are cut at 32767 steps on both sides.
"""


class PackedArray(str):
    """Base64 of a little-endian array, which is data and no text."""

    __slots__ = ()


def pack_floats(values: ArrayLike) -> PackedArray:
    """Return the values as float32, row by row."""
    return _pack(values, "<f4")


def pack_log_odds(values: ArrayLike) -> PackedArray:
    """Return log-odds as int16 in steps of 1/256, at most ±127.99; not a number becomes `MISSING`."""
    scaled = np.asarray(values, np.float64) * LOG_ODDS_SCALE
    steps = np.clip(np.round(scaled), MISSING + 1, -MISSING - 1)
    return _pack(np.where(np.isnan(scaled), MISSING, steps), "<i2")


def _pack(values: ArrayLike, kind: str) -> PackedArray:
    return PackedArray(b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii"))


def code_words(words: Sequence[Any]) -> dict[str, Any]:
    """Return `words` once each, and a `codes` entry per place; None stays None.

    A column of a large run repeats few words thousands of times.
    """
    distinct = list(dict.fromkeys(words))
    code = {word: number for number, word in enumerate(distinct)}
    return {"words": distinct, "codes": [code[word] for word in words]}


def round_number(value: Any, digits: int = 4) -> float | None:
    """Return a JSON number of so many decimals; None for None and for not a number."""
    return None if value is None or value != value else round(float(value), digits)


def payload_script(name: str, value: Any, paths: tuple[str, ...] = ()) -> bytes:
    """Return the script `put(name, value)` in ASCII.

    A page that is opened as a file may load scripts, and fetch nothing. Text of `value` has visible signs in place
    of control and direction characters, and the last part alone of `paths` and other absolute paths. No `<` is
    left, so that no text can end the script.
    """
    return _script("put", name, _encode(value, paths))


def failure_script(name: str, words: str, paths: tuple[str, ...] = ()) -> bytes:
    """Return the script `refuse(name, words)`: the reason why there is no such payload, for the page to show."""
    return _script("refuse", name, _encode(words, paths))


def _script(function: str, name: str, value: Any) -> bytes:
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return f"{function}({json.dumps(name)},{text})\n".replace("<", "\\u003c").encode("ascii")


def _encode(value: Any, paths: tuple[str, ...]) -> Any:
    if isinstance(value, PackedArray):  # before text, which it is too: base64 has nothing to escape, and is long
        return value
    if isinstance(value, str):
        return without_folders(terminal_safe(value), paths)
    if isinstance(value, dict):
        return {_encode(key, paths): _encode(entry, paths) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_encode(entry, paths) for entry in value]
    return value


# -- runs --------------------------------------------------------------------------------------------------------


SCENE_VIEWS = ("overview", "map", "episodes", "compare", "questions", "results")
OTHER_VIEWS = ("overview", "map", "episodes")
"""Views of a run of the scene, and of one without sides: its overview holds the results."""
_PROBED = (BACKBONE, BACKBONE_VERDICT, ACTION, ACTION_VERDICT, RETENTION)


def run_payload(viewed: ViewedRun, page_runs: Sequence[ViewedRun] = ()) -> dict[str, Any]:
    """Return everything that is stated once per run.

    Args:
        viewed: The run, as the page names it.
        page_runs: Runs of the page, of which VLM runs give a column.
    """
    run, results = viewed.run, viewed.results
    certificate = run.certificate if len(run.episodes) else {}
    success = EnvironmentSuccess.of(run.episodes)
    return {
        "key": viewed.key,
        "label": run.label,
        "model": run.model,
        "suite": run.suite,
        "success": None if success is None else {**success.to_json(), "sentence": success.sentence},
        "wording": run.wording,
        "random_weights": run.random_weights,
        "weights": run.weights_sha256,
        "planned": run.planned,
        "committed": len(run.episodes),
        "failed": len(run.failed),
        "answers": viewed.answers,
        "sides": viewed.run.source.is_scene,
        "views": list(SCENE_VIEWS if viewed.run.source.is_scene else OTHER_VIEWS),
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
        "sites": _site_entries(viewed.sites),
        "categories": [
            {"name": name, "title": category_of(name).title, "best": best_sites(viewed, name)}
            for name in viewed.categories
        ],
        "scene": _scene(run.settings.get("scene")),
        "rules": dict(RULES),
        "certificate": {
            "same_actions": certificate.get("hooks_on_equals_hooks_off"),
            "device": certificate.get("device"),
        },
        "table": _table(viewed, [other for other in page_runs if other.answers and other.run.suite == run.suite]),
        "notes": list(viewed.table.notes) if len(run.episodes) and viewed.run.source.is_scene else [],
        "settings": {name: str(value) for name, value in flat_settings(run.settings).items()},
        "stamp": run.stamp,
    }


def _site_entries(sites: Sequence[Site]) -> list[dict[str, Any]]:
    return [
        {"name": str(site), "stream": site.stream, "layer": site.layer, "iteration": site.iteration}
        for site in sites
    ]


def best_sites(viewed: ViewedRun, category: str) -> dict[str, Any]:
    """Return by part the index of the best site among all, and whether it has signal; None without probes."""
    row = viewed.probed_rows.get(category) if viewed.run.source.is_scene else None
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
    """Return headings, a row per category and their mean, in the spelling of the retention table."""
    rows = [*viewed.rows.values(), viewed.mean] if len(viewed.run.episodes) and viewed.run.source.is_scene else []
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
    """Return the text of the table, and value and interval where the page draws them."""
    cell = column.cell(row)
    payload: dict[str, Any] = {"text": cell.text}
    if column.key in (SR.key, BACKBONE.key, ACTION.key) and isinstance(cell.value, float):
        payload["value"] = round_number(cell.value)
        payload["limits"] = None if cell.interval is None else [round_number(limit) for limit in cell.interval]
    return payload


# -- site maps ---------------------------------------------------------------------------------------------------


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
    """Return scores by site, spelt as in the tables; log-odds (S, E) packed, toward the correct side.

    `rows` holds the place of each of the E episodes among those of the run. `refitted` holds the same scores of
    probes that were fitted to later inferences, by inference.

    Args:
        viewed: A run with probes of its own or of another run.
        category: A probed category.

    Raises:
        KeyError: For a category without probes.
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
    """Return the scores by site of a target that was probed.

    Args:
        viewed: A run with probes of targets.
        number: Position of the target among those that were probed.

    Raises:
        KeyError: For a number without a target.
    """
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
        "sites": _site_entries(results.curves[category, view].sites),
        "headings": (f"{metric} [95 %]", "chance", "p of this site", "p, family-wise", "verdict"),
        "cells": [_target_cells(row) for row in scores.to_dict("records")],
        "score": _numbers(scores["score"]),
        "chance": _numbers(scores["chance"]),
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


def _first_log_odds(viewed: ViewedRun, category: str) -> tuple[list[int], Matrix]:
    """Return rows of the E episodes that the probes of a category read, and their log-odds (S, E)."""
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
        "accuracy": _numbers(scores["accuracy"]),
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


# -- results -----------------------------------------------------------------------------------------------------


def results_payload(viewed: ViewedRun) -> dict[str, Any]:
    """Return the tables of a run, each with its kind, its key and its finding in sentences.

    Under `refused` are the reasons why others cannot be read, such as a diagnosis in the format of another
    version.
    """
    tables, refused = list[dict[str, Any]](), list[str]()
    for part in _parts(viewed) if len(viewed.run.episodes) else ():
        try:
            tables += part()
        except RunDamagedError as error:
            refused.append(str(error))
    return {"tables": tables, "refused": refused}


def _parts(viewed: ViewedRun) -> Iterator[Callable[[], Iterable[dict[str, Any]]]]:
    """Yield functions that read stored results, each apart, so that one that cannot be read hides no other."""
    for key in bundle_keys(viewed.run.location, DIAGNOSES):
        yield partial(_diagnosis, viewed, key)
    for read in (_interventions, _targets, _action_errors):
        yield partial(read, viewed)


def stored_keys(viewed: ViewedRun) -> list[str]:
    """Return the keys of everything except the episodes that `results_payload` is made of."""
    return [key for home in (DIAGNOSES, INTERVENTIONS, PROBES) for key in bundle_keys(viewed.run.location, home)]


def _diagnosis(viewed: ViewedRun, key: str) -> Iterator[dict[str, Any]]:
    # The sentences of a diagnosis are the notes of its table.
    yield _result_table("diagnosis of the inputs", key, diagnosis_table(load_diagnosis(viewed.run, key)), ())


def _interventions(viewed: ViewedRun) -> Iterator[dict[str, Any]]:
    """Yield the tables of interventions that verdicts and tables read; others add nothing."""
    used = {listed.key for listed in listed_interventions(viewed.run) if listed.state == "used"}
    for stored in stored_interventions(viewed.run):
        if stored.key in used:
            result = InterventionResult.of_stored(stored)
            table = _result_table(f"intervention {result.kind}", stored.key, result.to_rich(), result.findings)
            yield table | {"curves": _cut_charts(result) if result.kind == Knockout.kind else []}


def _cut_charts(result: InterventionResult) -> list[dict[str, Any]]:
    """Return a chart for every category and growth of windows, with a line a role and one of the controls."""
    charts = []
    for category in dict.fromkeys(row.category for row in result.effects):
        effects = [row for row in result.effects if row.category == category]
        curves = cut_curves(effects)
        for growth in dict.fromkeys(curve.growth for curve in curves):
            lines = [curve for curve in curves if curve.growth == growth]
            charts.append(
                {
                    "title": f"{category_of(category).title}: cut {growth} the layer",
                    "unit": measure_of_cuts(effects),
                    "layers": lines[0].layers.tolist(),
                    "lines": [
                        {"name": line.role, "values": _numbers(line.lost), "read": line.is_read.tolist()}
                        for line in lines
                    ],
                    # A role may have no control, and a layer none of any role.
                    "controls": _numbers(pd.DataFrame([line.controls for line in lines]).mean()),
                }
            )
    return charts


def _numbers(values: Iterable[float]) -> list[float | None]:
    return [round_number(value) for value in values]


def _targets(viewed: ViewedRun) -> Iterator[dict[str, Any]]:
    for target in stored_targets(viewed.run):
        results = load_results(viewed.run, target=target)
        yield _result_table(
            f"probes of {target}", results.key, best_sites_table([results]), best_sites_findings(results)
        )


def _action_errors(viewed: ViewedRun) -> Iterator[dict[str, Any]]:
    if viewed.run.recorded and why_not_compared(viewed.run) is None:
        yield _result_table("predicted actions", "", action_error_table(compare_actions(viewed.run)), ())


def _result_table(kind: str, key: str, table: Table, findings: Sequence[str]) -> dict[str, Any]:
    return {
        "kind": kind,
        "key": key,
        "title": table.title,
        "names": table.names,
        "headings": [
            {"text": heading.text, "help": heading.help, "group": heading.group} for heading in table.headings
        ],
        "rows": [_row(row) for row in table.rows],
        "notes": list(table.all_notes),
        "findings": list(findings),
    }


def _row(row: TableRow) -> list[dict[str, Any]]:
    return [{"text": cell.text, "strong": cell.strong, "note": cell.note} for cell in row.cells]
