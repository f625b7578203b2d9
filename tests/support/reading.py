"""Everything readable in a run, as hashes: a fault may prevent reading but never change it."""

import warnings
from collections.abc import Callable
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit.intervene import load_effects, stored_interventions
from probe_kit.runs import open_run
from probe_kit.runs.run import NotSealedWarning, Run
from probe_kit.runs.thumbnails import read_thumbnail
from probe_kit.train import load_results
from probe_kit.train.results.inventory import inventory

Readings = dict[str, Callable[[], Any]]


def readings(where: Path | str, first: str = "", allow_partial: bool = False) -> dict[str, str]:
    """A hash by what was asked. Raises what reading raises.

    first: what is asked first, so that a fault there is met early.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotSealedWarning)  # said aloud, and the numbers are the same
        run = open_run(where, allow_partial)
        questions = _of_run(run) | _of_probes(run) | _of_interventions(run)
        return {name: _hash(questions[name]()) for name in sorted(questions, key=lambda name: first not in name)}


def _of_run(run: Run) -> Readings:
    names = (run.model, run.label, run.weights_sha256, run.random_weights, run.suite, run.settings_sha256)
    rows = range(len(run.episodes))
    asked: Readings = {
        "names": lambda: names,
        "episodes": lambda: run.episodes.to_csv(),
        "failed": lambda: run.failed,
        "provenance": lambda: run.provenances,
        "certificate": lambda: run.certificate,
        "columns labelled": lambda: [array.values for array in run.xarray().data_vars.values()],
        "trajectory": lambda: [run.trajectory(row).frames for row in rows],
        "pictures": lambda: [read_thumbnail(run.location, number) for number in run.episodes["episode"]],
        "instructions": lambda: [run.instruction_ids(row) for row in rows],
    }
    for stream in run.streams:
        asked[f"rows pooled {stream}"] = lambda stream=stream: [run.rows(stream)[row] for row in rows]
        asked[f"rows tokens {stream}"] = lambda stream=stream: [run.rows(stream, "tokens")[row] for row in rows]
        asked[f"tokens {stream}"] = partial(run.tokens, run.sites(stream)[-1])
        for site in run.sites(stream):
            for view in run.views(stream):
                asked[f"columns {site} {view}"] = partial(run.column, site, view)
    return asked


def _of_probes(run: Run) -> Readings:
    asked: Readings = {"probes inventory": lambda: [str(one) for one in inventory(run).probes]}
    for key in (None, *(one.key for one in inventory(run).probes)):
        asked[f"probes {key}"] = partial(_results, run, key)
    return asked


def _of_interventions(run: Run) -> Readings:
    def effects() -> Any:
        return [load_effects(run, one.key).to_json() for one in stored_interventions(run)]

    return {"interventions": effects}


def _results(run: Run, key: str | None) -> Any:
    results = load_results(run, key)
    places = sorted(map(str, results.directions))
    weights = [vars(one) for one in results.directions.values()]
    return results.key, results.scores.to_csv(), str(results.controls), places, weights


def _hash(value: Any) -> str:
    found = blake2b(digest_size=16)
    _feed(found, value)
    return found.hexdigest()


def _feed(found: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        found.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, dict):
        _feed(found, [part for pair in sorted(value.items()) for part in pair])
    elif isinstance(value, list | tuple):
        for part in value:
            _feed(found, part)
    else:
        found.update(repr(value).encode())
