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
    run_readings: Readings = {
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
        run_readings[f"rows pooled {stream}"] = lambda stream=stream: [run.rows(stream)[row] for row in rows]
        run_readings[f"rows tokens {stream}"] = lambda stream=stream: [
            run.rows(stream, "tokens")[row] for row in rows
        ]
        run_readings[f"tokens {stream}"] = partial(run.tokens, run.sites(stream)[-1])
        for site in run.sites(stream):
            for view in run.views(stream):
                run_readings[f"columns {site} {view}"] = partial(run.column, site, view)
    return run_readings


def _of_probes(run: Run) -> Readings:
    probe_readings: Readings = {"probes inventory": lambda: [str(entry) for entry in inventory(run).probes]}
    for key in (None, *(entry.key for entry in inventory(run).probes)):
        probe_readings[f"probes {key}"] = partial(_results, run, key)
    return probe_readings


def _of_interventions(run: Run) -> Readings:
    def effects() -> Any:
        return [load_effects(run, intervention.key).to_json() for intervention in stored_interventions(run)]

    return {"interventions": effects}


def _results(run: Run, key: str | None) -> Any:
    results = load_results(run, key)
    places = sorted(map(str, results.directions))
    weights = [vars(direction) for direction in results.directions.values()]
    return results.key, results.scores.to_csv(), str(results.controls), places, weights


def _hash(value: Any) -> str:
    digest = blake2b(digest_size=16)
    _feed(digest, value)
    return digest.hexdigest()


def _feed(digest: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, dict):
        _feed(digest, [part for pair in sorted(value.items()) for part in pair])
    elif isinstance(value, list | tuple):
        for part in value:
            _feed(digest, part)
    else:
        digest.update(repr(value).encode())
