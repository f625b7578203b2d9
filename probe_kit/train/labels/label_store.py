"""Storage of probes of a label: `RUN/probes/<key>/`, beside the other probes, either complete or absent."""

import json
from collections import Counter
from dataclasses import asdict
from datetime import UTC, datetime
from io import BytesIO
from typing import Any

import numpy as np

from probe_kit._system.bounded_arrays import UNREADABLE, open_arrays
from probe_kit._system.csv_text import csv_of_frame
from probe_kit.errors import NoProbesError, RunDamagedError, UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.runs.layout import PROBES
from probe_kit.runs.results import Bundle, complete_key, write_bundle
from probe_kit.train.choices import TARGETS
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.labels.label_results import LabelControls, LabelCurve, LabelResults
from probe_kit.train.labels.label_settings import LabelSettings
from probe_kit.train.results.probe_results import episodes_sha256
from probe_kit.train.results.store import read_probes, stamp_of_run
from probe_kit.train.settings import LABEL_FORMAT

SCORES, PREDICTIONS, CONTROLS = "scores.csv", "predictions.npz", "controls.json"
_SAMPLES = ("labels", "episodes", "inferences", "groups", "fold_of")
_ALIGNED = "aligned"
_CURVE = ("predictions", "scores", "null", "penalties", "inner")


def save_label_results(results: LabelResults, run: RunReader) -> None:
    """Store `results` with the run, or the controls of results that are stored already."""
    head: dict[str, Any] = {"settings": asdict(results.settings), "stamp": results.stamp}
    head |= {
        "classes": list(results.classes),
        "left_out": dict(results.left_out),
        "smallest_p": results.smallest_p,
    }
    files = {
        SCORES: csv_of_frame(results.scores).encode(),
        PREDICTIONS: _packed(results),
        CONTROLS: json.dumps(results.controls.to_json(), indent=2).encode(),
    }
    now = datetime.now(UTC).isoformat(timespec="microseconds")
    write_bundle(run.location, PROBES, results.key, head, files, {"created": results.created, "asked": now})


def load_label_results(run: RunReader, key: str | None = None, target: str | None = None) -> LabelResults:
    """The stored probes of a label called `key`, or else the newest, of `target` if that is given.

    key: as `probe-kit run show` lists it; its beginning will do. Newest: those that were asked for last, of the
    episodes that the run has now. Raises NoProbesError if there are none, UsageError for a key that is not there
    or of another target, and RunDamagedError for results that were changed.
    """
    if key is not None:
        stored = {name: bundle for name, bundle in read_probes(run.location).items() if is_of_label(bundle)}
        found = stored[complete_key(key, stored, run.location, "probes of labels")]
        if target not in (None, found.head["settings"]["target"]):
            raise UsageError(
                f"{run.location}: the probes {found.key} are of {found.head['settings']['target']!r}, not of "
                f"{target!r}. Give their key with --target {found.head['settings']['target']}, or leave it out"
            )
        return _read(run, found)
    current, count = _current(run)
    current = [bundle for bundle in current if target in (None, bundle.head["settings"].get("target"))]
    if not current:
        if target in TARGETS:
            raise NoProbesError(
                f"{run.location} has no probes of a label {target!r}, which is the name of a side. Leave --target "
                "out for the retention of sides"
            )
        of = "" if target is None else f" {target!r}"
        raise NoProbesError(
            f"{run.location} has no probes of a label{of} on its episodes (of {count} stored). Run "
            f"`probe-kit train {run.location} --target COLUMN`"
        )
    return _read(run, max(current, key=lambda bundle: (bundle.times.get("asked", ""), bundle.key)))


def stored_targets(run: RunReader) -> tuple[str, ...]:
    """The label columns of which the run has probes on its present episodes, in alphabetical order."""
    return tuple(stored_versions(run))


def stored_versions(run: RunReader) -> dict[str, int]:
    """The same, with the number of different values that each column had: every one of them was a test."""
    settings = [bundle.head["settings"] for bundle in _current(run)[0]]
    return dict(
        sorted(Counter(target for target, _ in {(str(o["target"]), o["label"]) for o in settings}).items())
    )


def _current(run: RunReader) -> tuple[list[Bundle], int]:
    """Probes of labels on the episodes that the run has now, and how many there are of any episodes."""
    stored = [bundle for bundle in read_probes(run.location).values() if is_of_label(bundle)]
    now = run.settings_sha256, episodes_sha256(run)
    own = [bundle.head["settings"] for bundle in stored]
    return [
        bundle
        for bundle, settings in zip(stored, own, strict=True)
        if (settings.get("run_settings"), settings.get("episodes")) == now
    ], len(stored)


def is_of_label(bundle: Bundle) -> bool:
    """Whether stored probes are of a label of one's own."""
    return bool(bundle.head["settings"].get("format") == LABEL_FORMAT)


def _packed(results: LabelResults) -> bytes:
    arrays: dict[str, Any] = {name: getattr(results, name) for name in _SAMPLES}
    if results.aligned is not None:
        arrays[_ALIGNED] = results.aligned
    for view, curve in results.curves.items():
        arrays |= {f"{view}/{name}": getattr(curve, name) for name in _CURVE}
        arrays[f"{view}/sites"] = np.array([str(site) for site in curve.sites])
        arrays[f"{view}/parts"] = np.array(curve.parts)
    file = BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _read(run: RunReader, bundle: Bundle) -> LabelResults:
    stored, stamp = bundle.head["settings"], str(bundle.head.get("stamp", ""))
    if stamp and (now := stamp_of_run(run)) and stamp != now and stored.get("episodes") == episodes_sha256(run):
        raise RunDamagedError(
            f"{run.location}/{bundle.folder} holds probes of other activations than the run has. Remove it and "
            "run the same `probe-kit train` again"
        )
    try:
        lists = {name: tuple(stored[name]) for name in ("categories", "views")}
        settings = LabelSettings(**{**stored, **lists})
        with open_arrays(bundle.read(PREDICTIONS)) as arrays:
            samples = {name: arrays[name] for name in _SAMPLES}
            aligned = arrays.get(_ALIGNED)
            curves = {view: _curve(arrays, view) for view in settings.views}
        controls = LabelControls.from_json(bundle.read_json(CONTROLS))
        return LabelResults(
            settings,
            tuple(bundle.head["classes"]),
            **samples,
            curves=curves,
            smallest_p=bundle.head["smallest_p"],
            left_out=bundle.head["left_out"],
            controls=controls,
            created=bundle.times.get("created", ""),
            stamp=stamp,
            aligned=aligned,
        )
    except (*UNREADABLE, TypeError) as error:
        raise RunDamagedError(
            f"{run.location}/{bundle.folder} holds no probes of a label: {error!r}. Remove {bundle.folder} and "
            "run the same `probe-kit train` again"
        ) from error


def _curve(arrays: Any, view: str) -> LabelCurve:
    return LabelCurve(
        tuple(Site.parse(str(name)) for name in arrays[f"{view}/sites"]),
        tuple(str(part) for part in arrays[f"{view}/parts"]),
        **{name: arrays[f"{view}/{name}"] for name in _CURVE},
    )
