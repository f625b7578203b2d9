"""Where probe results live: `RUN/probes/<key>/`, complete or not there, and what an interrupted sweep left."""

import json
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit.errors import NoProbesError, UsageError
from probe_kit.hooks.sites import Site
from probe_kit.train.controls import Controls
from probe_kit.train.curve import Curve
from probe_kit.train.directions import StoredDirections, save_directions
from probe_kit.train.probe import SiteProbe
from probe_kit.train.reader import RunReader
from probe_kit.train.results import FORMAT, ProbeResults, ProbeSettings, episodes_sha256
from probe_kit.train.targets import Target

HOME = "probes"
CONTROLS = "controls.json"


def save_results(results: ProbeResults, run_path: Path) -> Path:
    """Write to `run_path/probes/<key>/`, all or nothing, and return that folder. Keeps what is there."""
    folder = run_path / HOME / results.key
    if folder.exists():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{results.key}.", dir=folder.parent) as aside:
        draft = Path(aside) / results.key
        draft.mkdir()
        header = {"settings": asdict(results.settings), "created": results.created}
        (draft / "settings.json").write_text(json.dumps(header, indent=2))
        results.scores.to_csv(draft / "scores.csv", index=False)
        np.savez_compressed(draft / "decisions.npz", allow_pickle=False, **_pack(results.curves))
        save_directions(results.directions, draft / "directions.npz")
        shutil.move(draft, folder)
    return folder


def save_controls(results: ProbeResults, run_path: Path) -> Path:
    """Write the controls of stored results beside them, over former ones, and return that file."""
    file = run_path / HOME / results.key / CONTROLS
    draft = file.with_suffix(".draft")
    draft.write_text(json.dumps(results.controls.to_json(), indent=2))
    return draft.replace(file)


def is_stored(run_path: Path, key: str) -> bool:
    """Whether complete results called `key` are there."""
    return (run_path / HOME / key).exists()


def load_results(run: RunReader, key: str | None = None, target: Target = "correct") -> ProbeResults:
    """The stored results called `key`, or else the newest for `target` on the episodes the run has now.

    Results of another format, written by another version of probe_kit, are passed over.
    Raises NoProbesError if there are none, and UsageError for a key that is not there.
    """
    headers = sorted((run.path / HOME).glob("[!.]*/settings.json"))
    stored = {path.parent.name: path.parent for path in headers if _format(path) == FORMAT}
    if key is not None:
        if key not in stored:
            raise UsageError(f"{run.path} has no probe results {key!r}; it has: {', '.join(stored) or 'none'}")
        return _read(stored[key])
    episodes = episodes_sha256(run)
    current = {
        folder: str(created)
        for folder, (settings, created) in ((folder, _read_header(folder)) for folder in stored.values())
        if (settings.target, settings.run_settings, settings.episodes) == (target, run.settings_sha256, episodes)
    }
    if not current:
        why = "has no activations" if not run.streams else f"has no probes for target {target!r} on its episodes"
        raise NoProbesError(f"{run.path} {why}. Run `probe-kit train {run.path}` on a run with activations.")
    return _read(max(current, key=lambda folder: (current[folder], folder.name)))


@dataclass(frozen=True)
class Unfinished:
    """Probes of single sites, kept until the sweep they belong to is complete."""

    folder: Path

    @classmethod
    def of(cls, run_path: Path, key: str) -> "Unfinished":
        """Those of the sweep that will be stored as `key`."""
        return cls(run_path / HOME / f".{key}.partial")

    def read(self, view: str, site: Site) -> dict[str, SiteProbe] | None:
        """The probes of a site by category, or None if the sweep did not get that far."""
        file = self._file(view, site)
        if not file.exists():
            return None
        with np.load(file, allow_pickle=False) as arrays:
            return {
                category: SiteProbe(**{part: arrays[f"{category}/{part}"] for part in SiteProbe.__annotations__})
                for category in dict.fromkeys(name.rsplit("/", 1)[0] for name in arrays)
            }

    def keep(self, view: str, site: Site, probes: Mapping[str, SiteProbe]) -> None:
        """Store the probes of a site by category."""
        self.folder.mkdir(parents=True, exist_ok=True)
        file = self._file(view, site)
        draft = file.with_suffix(".draft.npz")
        arrays = {
            f"{category}/{part}": array
            for category, probe in probes.items()
            for part, array in vars(probe).items()
        }
        np.savez(draft, allow_pickle=False, **arrays)
        draft.replace(file)

    def discard(self) -> None:
        """Remove everything: the sweep is complete."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _file(self, view: str, site: Site) -> Path:
        return self.folder / f"{view}+{site}.npz"


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


def _format(header: Path) -> int:
    return int(json.loads(header.read_text())["settings"]["format"])


def _read_header(folder: Path) -> tuple[ProbeSettings, str]:
    header = json.loads((folder / "settings.json").read_text())
    stored = header["settings"]
    settings = ProbeSettings(
        **{**stored, "categories": tuple(stored["categories"]), "views": tuple(stored["views"])}
    )
    return settings, header["created"]


def _read(folder: Path) -> ProbeResults:
    settings, created = _read_header(folder)
    directions, controls = StoredDirections(folder / "directions.npz"), folder / CONTROLS
    with np.load(folder / "decisions.npz", allow_pickle=False) as arrays:
        curves = _unpack(arrays)
    found = Controls.from_json(json.loads(controls.read_text())) if controls.exists() else Controls()
    return ProbeResults(settings, curves, directions, found, created)
