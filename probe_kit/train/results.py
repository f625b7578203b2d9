"""Probe results: a table of scores, the out-of-fold decisions behind it, and their home inside the run."""

import json
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NoProbesError, UsageError
from probe_kit.hooks.sites import Site
from probe_kit.identity import derive_seed, sha256_json
from probe_kit.train.folds import Fold
from probe_kit.train.permutation import family_p, site_p
from probe_kit.train.reader import RunReader
from probe_kit.train.scores import (
    balanced_accuracy,
    chance_level,
    correctness,
    fold_auc,
    group_bootstrap,
    log_loss,
)
from probe_kit.train.targets import Target

if TYPE_CHECKING:
    import pandas as pd

FORMAT = 1  # raise when the same settings would give other numbers


@dataclass(frozen=True)
class ProbeSettings:
    """Everything that decides the numbers; its hash is the results' key."""

    model: str
    random_weights: bool
    suite: str
    run_settings: str
    episodes: str  # sha256 of the episode ids, so that a run that grew is probed again
    categories: tuple[str, ...]
    views: tuple[str, ...]
    target: Target
    permutations: int
    seed: int
    format: int = FORMAT

    @property
    def key(self) -> str:
        """First 12 hex digits of the settings' sha256: the name of the results' folder."""
        return sha256_json(asdict(self))[:12]


@dataclass(frozen=True)
class Curve:
    """All sites of one category in one view, on the same episodes (E), folds (F) and relabellings (P).

    sites: S of them. labels: (E,) bool. episodes, items, groups: (E,) identities. fold_of: (E,) outer fold.
    decisions: (S, E) out-of-fold. strengths: (S, F) chosen C. null: (S, P) accuracies under relabelling.
    """

    sites: tuple[Site, ...]
    labels: NDArray[np.bool_]
    episodes: NDArray[np.str_]
    items: NDArray[np.str_]
    groups: NDArray[np.str_]
    fold_of: NDArray[np.int64]
    decisions: NDArray[np.float64]
    strengths: NDArray[np.float64]
    null: NDArray[np.float64]

    @property
    def correct(self) -> NDArray[np.bool_]:
        """(S, E) whether each episode's held-out decision is right."""
        return correctness(self.decisions, self.labels[None, :])

    @property
    def chance(self) -> float:
        """Accuracy of always naming the larger class."""
        return chance_level(self.labels)

    @property
    def n_groups(self) -> int:
        """Number of independent groups of items."""
        return int(np.unique(self.groups).size)

    def stream(self, name: str) -> NDArray[np.intp]:
        """Positions of the sites of one stream."""
        return np.flatnonzero([site.stream == name for site in self.sites])

    def p_fwe(self) -> NDArray[np.float64]:
        """(S,) family-wise p: each stream's sites are one family."""
        p = np.empty(len(self.sites))
        accuracy = self.correct.mean(axis=1)
        for name in {site.stream for site in self.sites}:
            rows = self.stream(name)
            p[rows] = family_p(accuracy[rows], self.null[rows])
        return p

    def folds(self) -> list[Fold]:
        """The outer folds."""
        return [
            Fold(np.flatnonzero(self.fold_of != f), np.flatnonzero(self.fold_of == f)) for f in self._fold_names
        ]

    @property
    def _fold_names(self) -> list[int]:
        return [int(fold) for fold in np.unique(self.fold_of)]


@dataclass(frozen=True)
class ProbeResults:
    """Probes of one run under one set of settings.

    curves: one per (category, view). layers: number of layers of every stream, to give depths as fractions.
    created: when they were fitted (UTC, ISO 8601); not part of the key.
    """

    settings: ProbeSettings
    curves: Mapping[tuple[str, str], Curve]
    layers: Mapping[str, int]
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="microseconds"))

    @property
    def key(self) -> str:
        """Hash of the settings."""
        return self.settings.key

    def depth(self, site: Site) -> float:
        """Layer of `site` as a fraction of its stream: 0 enters the first block, 1 leaves the last."""
        return site.layer / max(1, self.layers[site.stream] - 1)

    @cached_property
    def scores(self) -> "pd.DataFrame":
        """One row per category, view and site.

        `accuracy` with its 95 % interval over groups (`ci_low`, `ci_high`), `p` of the site alone, `p_fwe`
        against the best site of the stream, `depth` the layer as a fraction, `C` and `fold_accuracy` per
        outer fold.
        """
        import pandas as pd

        rows = [
            row
            for (category, view), curve in self.curves.items()
            for row in _score_rows(self, category, view, curve)
        ]
        return pd.DataFrame(rows).astype({"iteration": "Int64"})

    def save(self, run_path: Path) -> Path:
        """Write to `run_path/probes/<key>/`, all or nothing, and return that folder. Keeps what is there."""
        folder = run_path / "probes" / self.key
        if folder.exists():
            return folder
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{self.key}.", dir=folder.parent) as aside:
            draft = Path(aside) / self.key
            draft.mkdir()
            header = {"settings": asdict(self.settings), "layers": dict(self.layers), "created": self.created}
            (draft / "settings.json").write_text(json.dumps(header, indent=2))
            self.scores.to_csv(draft / "scores.csv", index=False)
            np.savez_compressed(draft / "decisions.npz", allow_pickle=False, **_pack(self.curves))
            shutil.move(draft, folder)
        return folder


def load_results(run: RunReader, key: str | None = None, target: Target = "correct") -> ProbeResults:
    """The stored results called `key`, or else the newest for `target` on the episodes the run has now.

    Raises NoProbesError if there are none, and UsageError for a key that is not there.
    """
    stored = {path.parent.name: path.parent for path in sorted((run.path / "probes").glob("[!.]*/settings.json"))}
    if key is not None:
        if key not in stored:
            raise UsageError(f"{run.path} has no probe results {key!r}; it has: {', '.join(stored) or 'none'}")
        return _read(stored[key])
    episodes = episodes_sha256(run)
    headers = {folder: _read_header(folder) for folder in stored.values()}
    current = {
        folder: str(created)
        for folder, (settings, _, created) in headers.items()
        if settings.target == target and settings.episodes == episodes
    }
    if not current:
        why = "has no activations" if not run.streams else f"has no probes for target {target!r} on its episodes"
        raise NoProbesError(f"{run.path} {why}. Run `probe-kit train {run.path}` on a run with activations.")
    return _read(max(current, key=lambda folder: (current[folder], folder.name)))


def episodes_sha256(run: RunReader) -> str:
    """Identity of the episodes a run holds now."""
    return sha256_json(sorted(run.episodes["episode_id"].astype(str)))


def _score_rows(results: ProbeResults, category: str, view: str, curve: Curve) -> list[dict[str, Any]]:
    settings, folds, correct = results.settings, curve.folds(), curve.correct
    accuracy = correct.mean(axis=1)
    low, high = group_bootstrap(correct.T, curve.groups, derive_seed("interval", settings.seed, category, view))
    p, p_fwe = site_p(accuracy, curve.null), curve.p_fwe()
    return [
        {
            "model": settings.model,
            "random_weights": settings.random_weights,
            "target": settings.target,
            "category": category,
            "view": view,
            "site": str(site),
            "stream": site.stream,
            "layer": site.layer,
            "depth": results.depth(site),
            "iteration": site.iteration,
            "accuracy": accuracy[row],
            "ci_low": low[row],
            "ci_high": high[row],
            "balanced_accuracy": balanced_accuracy(curve.decisions[row], curve.labels),
            "auc": fold_auc(curve.decisions[row], curve.labels, folds),
            "log_loss": float(log_loss(curve.decisions[row], curve.labels)),
            "p": p[row],
            "p_fwe": p_fwe[row],
            "n": curve.labels.size,
            "items": np.unique(curve.items).size,
            "groups": curve.n_groups,
            "chance": curve.chance,
            "C": " ".join(f"{strength:g}" for strength in curve.strengths[row]),
            "fold_accuracy": " ".join(f"{correct[row, fold.test].mean():.4f}" for fold in folds),
            "settings": settings.key,
        }
        for row, site in enumerate(curve.sites)
    ]


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


def _read_header(folder: Path) -> tuple[ProbeSettings, dict[str, int], str]:
    header = json.loads((folder / "settings.json").read_text())
    stored = header["settings"]
    settings = ProbeSettings(
        **{**stored, "categories": tuple(stored["categories"]), "views": tuple(stored["views"])}
    )
    return settings, header["layers"], header["created"]


def _read(folder: Path) -> ProbeResults:
    settings, layers, created = _read_header(folder)
    with np.load(folder / "decisions.npz", allow_pickle=False) as arrays:
        return ProbeResults(settings, _unpack(arrays), layers, created)
