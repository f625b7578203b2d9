"""Where probe results live: `RUN/probes/<key>/`, complete or not there.

Results are there when their settings are, which are written last.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit.errors import NoProbesError, UsageError
from probe_kit.extract.store.locate import locate
from probe_kit.extract.store.location import Location
from probe_kit.hooks.sites import Site
from probe_kit.train.at_call import at_call, captured_calls
from probe_kit.train.controls import Controls
from probe_kit.train.curve import Curve
from probe_kit.train.directions import StoredDirections, save_directions
from probe_kit.train.reader import RunReader
from probe_kit.train.results import ProbeResults, episodes_sha256
from probe_kit.train.settings import FORMAT, ProbeSettings
from probe_kit.train.targets import Target

HOME = "probes"
SETTINGS, SCORES, DECISIONS = "settings.json", "scores.csv", "decisions.npz"
DIRECTIONS, CONTROLS = "directions.npz", "controls.json"


def save_results(results: ProbeResults, run: Path | Location, *, asked: bool = True) -> None:
    """Write to `probes/<key>/` of the run that lies there, all or nothing; probes that are there are kept.

    asked: whether somebody asked for these probes, which `load_results` then prefers to all older ones, rather
    than needing them in passing, as the twin of another run.
    """
    location, home = locate(run), f"{HOME}/{results.key}"
    if not is_stored(location, results.key):
        decisions, directions = BytesIO(), BytesIO()
        np.savez_compressed(decisions, allow_pickle=False, **_pack(results.curves))
        save_directions(results.directions, directions)
        location.write(f"{home}/{SCORES}", results.scores.to_csv(index=False).encode())
        location.write(f"{home}/{DECISIONS}", decisions.getvalue())
        location.write(f"{home}/{DIRECTIONS}", directions.getvalue())
        _save_controls(results, location)
        _write_header(location, results.key, _header(results, asked))
        return
    _save_controls(results, location)
    stored = read_headers(location)
    if asked and results.key != max(_ours(stored), key=lambda key: _rank(key, stored[key])):
        _write_header(location, results.key, {**stored[results.key], "asked": _now()})


def _header(results: ProbeResults, asked: bool) -> dict[str, Any]:
    settings = asdict(results.settings)
    return {"settings": settings, "created": results.created, "asked": _now() if asked else ""}


def _write_header(run: Location, key: str, header: Mapping[str, Any]) -> None:
    run.write(f"{HOME}/{key}/{SETTINGS}", json.dumps(header, indent=2).encode())


def _save_controls(results: ProbeResults, run: Location) -> None:
    """Write the controls beside the probes, over former ones, and what the scores say of them; nothing where
    nothing was controlled.
    """
    if results.controls != Controls():
        content = json.dumps(results.controls.to_json(), indent=2)
        run.write(f"{HOME}/{results.key}/{SCORES}", results.scores.to_csv(index=False).encode())
        run.write(f"{HOME}/{results.key}/{CONTROLS}", content.encode())


def is_stored(run: Location, key: str) -> bool:
    """Whether complete results called `key` are there."""
    return run.exists(f"{HOME}/{key}/{SETTINGS}")


def load_results(run: RunReader, key: str | None = None, target: Target = "correct") -> ProbeResults:
    """The stored results called `key`, or else the newest for `target` on the episodes the run has now.

    The newest are of the first captured inference; those of later ones are read by their key.

    key: as `probe-kit run show` lists it; its beginning will do. Newest: those that were asked for last, whether
    they were fitted then or read back. Results of another format, written by another version of probe_kit, are
    passed over. Raises NoProbesError if there are none, and UsageError for a key that is not there.
    """
    location = run.location
    headers = read_headers(location)
    stored = _ours(headers)
    if key is not None:
        found = [name for name in stored if name == key] or [
            name for name in stored if key and name.startswith(key)
        ]
        if len(found) != 1:
            raise UsageError(
                f"{location} has {'several' if found else 'no'} probe results {key!r}; it has: "
                f"{', '.join(stored) or 'none'}"
            )
        return _read(location, found[0], stored[found[0]])
    asked = [(name, settings_of(header)) for name, header in stored.items()]
    current = [name for name, settings in asked if (settings.target, settings.call) == (target, 0)]
    current = [name for name in current if is_current(settings_of(stored[name]), run)]
    if not current:
        raise NoProbesError(_why_none(run, target, len(headers)))
    newest = max(current, key=lambda name: _rank(name, stored[name]))
    return _read(location, newest, stored[newest])


def is_current(settings: ProbeSettings, run: RunReader) -> bool:
    """Whether probes of these settings are of the episodes that the run has now."""
    if settings.run_settings != run.settings_sha256 or settings.call >= max(captured_calls(run), 1):
        return False
    return settings.episodes == episodes_sha256(at_call(run, settings.call))


def _why_none(run: RunReader, target: Target, stored: int) -> str:
    if not run.streams:
        return f"{run.location} has no activations to probe: the policy {run.model!r} has no streams."
    others = f" (of {stored} stored, none: other episodes, another target or another version)" if stored else ""
    return (
        f"{run.location} has no probes for target {target!r} on its episodes{others}. "
        f"Run `probe-kit train {run.location}`."
    )


def _rank(key: str, header: Mapping[str, Any]) -> tuple[str, str, str]:
    """What is newest has the highest; results of former versions count as asked for when they were made."""
    return str(header.get("asked", header["created"])), str(header["created"]), key


def _ours(headers: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    return {name: header for name, header in headers.items() if header["settings"].get("format") == FORMAT}


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")


def _pack(curves: Mapping[tuple[str, str], Curve]) -> dict[str, Any]:
    """Arrays by `category/view/member`; views hold no slash."""
    return {
        f"{category}/{view}/{name}": np.array([str(own) for own in value]) if isinstance(value, tuple) else value
        for (category, view), curve in curves.items()
        for name, value in vars(curve).items()
    }


def _unpack(arrays: Mapping[str, Any]) -> dict[tuple[str, str], Curve]:
    members: dict[tuple[str, str], dict[str, Any]] = {}
    for name, value in arrays.items():
        category, view, member = name.rsplit("/", 2)
        members.setdefault((category, view), {})[member] = value
    return {
        pair: Curve(
            **{
                **found,
                "sites": tuple(Site.parse(str(name)) for name in found["sites"]),
                "parts": tuple(str(part) for part in found.get("parts", ())),
            }
        )
        for pair, found in members.items()
    }


def read_headers(run: Location) -> dict[str, dict[str, Any]]:
    """What the settings file of every complete result says, by key."""
    parts = (key.split("/") for key in run.keys(HOME))
    names = [own[1] for own in parts if own[2:] == [SETTINGS] and not own[1].startswith(".")]
    return {name: json.loads(run.read(f"{HOME}/{name}/{SETTINGS}")) for name in names}


def settings_of(header: Mapping[str, Any]) -> ProbeSettings:
    """The settings of results of this version's format."""
    stored = header["settings"]
    return ProbeSettings(**{**stored, "categories": tuple(stored["categories"]), "views": tuple(stored["views"])})


def read_controls(run: Location, key: str) -> Controls:
    """What the results called `key` were held against so far."""
    place = f"{HOME}/{key}/{CONTROLS}"
    return Controls.from_json(json.loads(run.read(place))) if run.exists(place) else Controls()


def _read(run: Location, key: str, header: Mapping[str, Any]) -> ProbeResults:
    home = f"{HOME}/{key}"
    with run.open(f"{home}/{DECISIONS}") as file, np.load(file, allow_pickle=False) as arrays:
        curves = _unpack(arrays)
    controls = read_controls(run, key)
    directions = StoredDirections(run, f"{home}/{DIRECTIONS}")
    return ProbeResults(settings_of(header), curves, directions, controls, header["created"])
