"""Where probe results live: `RUN/probes/<key>/`, complete or not there, and what an interrupted sweep left.

Results are there when their settings are, which are written last.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit.errors import NoProbesError, UsageError
from probe_kit.extract.store.locate import locate
from probe_kit.extract.store.location import Location
from probe_kit.hooks.sites import Site
from probe_kit.train.controls import Controls
from probe_kit.train.curve import Curve
from probe_kit.train.directions import StoredDirections, save_directions
from probe_kit.train.probe import SiteProbe
from probe_kit.train.reader import RunReader
from probe_kit.train.results import FORMAT, ProbeResults, ProbeSettings, episodes_sha256
from probe_kit.train.targets import Target

HOME = "probes"
SETTINGS, SCORES, DECISIONS = "settings.json", "scores.csv", "decisions.npz"
DIRECTIONS, CONTROLS = "directions.npz", "controls.json"


def save_results(results: ProbeResults, run: Path | Location) -> None:
    """Write to `probes/<key>/` of the run that lies there, all or nothing. Keeps what is there."""
    location, home = locate(run), f"{HOME}/{results.key}"
    if is_stored(location, results.key):
        return
    decisions, directions = BytesIO(), BytesIO()
    np.savez_compressed(decisions, allow_pickle=False, **_pack(results.curves))
    save_directions(results.directions, directions)
    header = {"settings": asdict(results.settings), "created": results.created}
    location.write(f"{home}/{SCORES}", results.scores.to_csv(index=False).encode())
    location.write(f"{home}/{DECISIONS}", decisions.getvalue())
    location.write(f"{home}/{DIRECTIONS}", directions.getvalue())
    location.write(f"{home}/{SETTINGS}", json.dumps(header, indent=2).encode())


def save_controls(results: ProbeResults, run: Path | Location) -> None:
    """Write the controls of stored results beside them, over former ones."""
    content = json.dumps(results.controls.to_json(), indent=2)
    locate(run).write(f"{HOME}/{results.key}/{CONTROLS}", content.encode())


def is_stored(run: Location, key: str) -> bool:
    """Whether complete results called `key` are there."""
    return run.exists(f"{HOME}/{key}/{SETTINGS}")


def load_results(run: RunReader, key: str | None = None, target: Target = "correct") -> ProbeResults:
    """The stored results called `key`, or else the newest for `target` on the episodes the run has now.

    Results of another format, written by another version of probe_kit, are passed over.
    Raises NoProbesError if there are none, and UsageError for a key that is not there.
    """
    location = run.location
    stored = {
        name: header for name, header in _headers(location).items() if header["settings"]["format"] == FORMAT
    }
    if key is not None:
        if key not in stored:
            raise UsageError(f"{location} has no probe results {key!r}; it has: {', '.join(stored) or 'none'}")
        return _read(location, key, stored[key])
    episodes = episodes_sha256(run)
    current = {
        name: str(stored[name]["created"])
        for name, settings in ((name, _settings(header)) for name, header in stored.items())
        if (settings.target, settings.run_settings, settings.episodes) == (target, run.settings_sha256, episodes)
    }
    if not current:
        why = "has no activations" if not run.streams else f"has no probes for target {target!r} on its episodes"
        raise NoProbesError(f"{location} {why}. Run `probe-kit train {location}` on a run with activations.")
    newest = max(current, key=lambda name: (current[name], name))
    return _read(location, newest, stored[newest])


@dataclass(frozen=True)
class Unfinished:
    """Probes of single sites, kept until the sweep they belong to is complete."""

    run: Location
    folder: str

    @classmethod
    def of(cls, run: Location, key: str) -> "Unfinished":
        """Those of the sweep that will be stored as `key`."""
        return cls(run, f"{HOME}/.{key}.partial")

    def read(self, view: str, site: Site) -> dict[str, SiteProbe] | None:
        """The probes of a site by category, or None if the sweep did not get that far."""
        try:
            stored = self.run.read(self._key(view, site))
        except FileNotFoundError:
            return None
        with np.load(BytesIO(stored), allow_pickle=False) as arrays:
            return {
                category: SiteProbe(**{part: arrays[f"{category}/{part}"] for part in SiteProbe.__annotations__})
                for category in dict.fromkeys(name.rsplit("/", 1)[0] for name in arrays)
            }

    def keep(self, view: str, site: Site, probes: Mapping[str, SiteProbe]) -> None:
        """Store the probes of a site by category."""
        arrays = {
            f"{category}/{part}": array
            for category, probe in probes.items()
            for part, array in vars(probe).items()
        }
        content = BytesIO()
        np.savez(content, allow_pickle=False, **arrays)
        self.run.write(self._key(view, site), content.getvalue())

    def discard(self) -> None:
        """Remove everything: the sweep is complete."""
        self.run.remove(self.folder)

    def _key(self, view: str, site: Site) -> str:
        return f"{self.folder}/{view}+{site}.npz"


def _pack(curves: Mapping[tuple[str, str], Curve]) -> dict[str, Any]:
    """Arrays by `category/view/member`; views hold no slash."""
    return {
        f"{category}/{view}/{name}": np.array([str(site) for site in value]) if name == "sites" else value
        for (category, view), curve in curves.items()
        for name, value in vars(curve).items()
    }


def _unpack(arrays: Mapping[str, Any]) -> dict[tuple[str, str], Curve]:
    members: dict[tuple[str, str], dict[str, Any]] = {}
    for name, value in arrays.items():
        category, view, member = name.rsplit("/", 2)
        members.setdefault((category, view), {})[member] = value
    return {
        pair: Curve(**{**found, "sites": tuple(Site.parse(str(name)) for name in found["sites"])})
        for pair, found in members.items()
    }


def _headers(run: Location) -> dict[str, dict[str, Any]]:
    """What the settings file of every complete result says, by key."""
    parts = (key.split("/") for key in run.keys(HOME))
    names = [own[1] for own in parts if own[2:] == [SETTINGS] and not own[1].startswith(".")]
    return {name: json.loads(run.read(f"{HOME}/{name}/{SETTINGS}")) for name in names}


def _settings(header: Mapping[str, Any]) -> ProbeSettings:
    stored = header["settings"]
    return ProbeSettings(**{**stored, "categories": tuple(stored["categories"]), "views": tuple(stored["views"])})


def _read(run: Location, key: str, header: Mapping[str, Any]) -> ProbeResults:
    home = f"{HOME}/{key}"
    with run.open(f"{home}/{DECISIONS}") as file, np.load(file, allow_pickle=False) as arrays:
        curves = _unpack(arrays)
    controls = Controls()
    if run.exists(f"{home}/{CONTROLS}"):
        controls = Controls.from_json(json.loads(run.read(f"{home}/{CONTROLS}")))
    directions = StoredDirections(run, f"{home}/{DIRECTIONS}")
    return ProbeResults(_settings(header), curves, directions, controls, header["created"])
