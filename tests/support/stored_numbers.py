"""Every number that a stored run holds, as hashes by what it is, whatever columns and records are called."""

import warnings
from hashlib import sha256
from typing import Any

import numpy as np

from probe_kit.extract.store.run import NotSealedWarning, Run
from probe_kit.extract.store.thumbnails import read_thumbnail
from probe_kit.intervene import stored_interventions
from probe_kit.train import load_results
from probe_kit.train.results.inventory import inventory


def numbers_of(run: Run) -> dict[str, str]:
    """Of activations, trajectories, pictures, probes and interventions; each with dtype and shape."""
    rows = range(len(run.episodes))
    found: dict[str, Any] = {
        "trajectories": [run.trajectory(row).frames for row in rows],
        "instruction ids": [np.array(run.instruction_ids(row)) for row in rows],
        "first and last frames": [np.frombuffer(_thumbnail(run, row), np.uint8) for row in rows],
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotSealedWarning)
        for stream in run.streams:
            found[f"rows of {stream}"] = [run.rows(stream)[row] for row in rows]
            found[f"columns of {stream}"] = [
                run.column(site, view) for site in run.sites(stream) for view in run.views(stream)
            ]
            if run.settings["tokens"] == "all":
                found[f"tokens of {stream}"] = [part for site in run.sites(stream) for part in run.tokens(site)]
    for own in inventory(run).probes:
        results = load_results(run, own.key)
        curves = [results.curves[place] for place in sorted(results.curves)]
        found[f"decisions of probes {own.key}"] = [curve.decisions for curve in curves]
        found[f"relabelled accuracies of probes {own.key}"] = [curve.null for curve in curves]
        places = sorted(results.directions, key=str)
        found[f"directions of probes {own.key}"] = [
            array for place in places for array in vars(results.directions[place]).values()
            if isinstance(array, np.ndarray)
        ]  # fmt: skip
    for stored in stored_interventions(run):
        found[f"displacements of intervention {stored.key}"] = [stored.outcomes().displacement]
    return {name: _hash(arrays) for name, arrays in found.items()}


def _thumbnail(run: Run, row: int) -> bytes:
    return read_thumbnail(run.location, int(run.episodes["episode"].iloc[row])) or b""


def _hash(arrays: list[Any]) -> str:
    found = sha256()
    for array in arrays:
        found.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:16]
