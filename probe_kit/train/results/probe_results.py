"""Probe results: a table of scores, and the out-of-fold decisions behind it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit.errors import UnknownSiteError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.sites import Site
from probe_kit.statistics.estimates.balanced import CHANCE
from probe_kit.statistics.estimates.shares import effective_groups, group_shares, wilson_interval
from probe_kit.statistics.label_permutations import pointwise_p, smallest_p
from probe_kit.train.crossval.metrics import fold_auc, log_loss
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.results.control_scores import Controls, has_signal
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_directions import Direction, Place
from probe_kit.train.results.summary import results_html, results_text
from probe_kit.train.settings import ProbeSettings

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, repr=False)
class ProbeResults:
    """Probes of one run under one set of settings.

    curves: one per (category, view). directions: the probes' weights per (category, view, site). controls: what
    the probes are compared with, as far as requested.
    created: when they were fitted (UTC, ISO 8601); not part of the key. stamp: hash of the commits they were
    fitted to, empty for arrays in memory. label: what tables call the run, by default its model; not part of the
    key either.
    """

    settings: ProbeSettings
    curves: Mapping[tuple[str, str], ProbeCurve]
    directions: Mapping[Place, Direction] = field(default_factory=dict)
    controls: Controls = field(default_factory=Controls)
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="microseconds"))
    stamp: str = ""
    label: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "label", self.label or self.settings.model)

    def __repr__(self) -> str:
        return results_text(self.settings, self.label)

    def _repr_html_(self) -> str:
        return results_html(self.settings, self.label, self.scores)

    @property
    def key(self) -> str:
        """Hash of the settings."""
        return self.settings.key

    @cached_property
    def scores(self) -> "pd.DataFrame":
        """One row per category, view and site.

        `accuracy` with its 95 % interval over groups (`ci_low`, `ci_high`), `p` of the site alone, `p_fwe`
        against the best site of the stream, `depth` the layer as a fraction, `C` and `fold_accuracy` per outer
        fold. `control_accuracy` is the mean accuracy of the same probe on random labels that are consistent
        within a group, `selectivity` the accuracy above it; NaN without label permutations. `smallest_p`: no
        p-value can be lower with so many label permutations. `exceeds_random_features`, `exceeds_untrained`:
        whether the site is better than that control, missing where it was not run; `signal`: than chance,
        family-wise, and every control that was run.
        """
        import pandas as pd

        rows = [
            row
            for (category, view), curve in self.curves.items()
            for row in _score_rows(self, category, view, curve)
        ]
        kinds = {"iteration": "Int64", "exceeds_random_features": "boolean", "exceeds_untrained": "boolean"}
        return pd.DataFrame(rows).astype(kinds)

    def direction(self, category: str, view: str, site: Site) -> Direction:
        """The probes' weights at a site, in raw features. Raises UnknownSiteError if it was not probed."""
        try:
            return self.directions[category, view, site]
        except KeyError:
            raise UnknownSiteError(
                f"there is no direction of {site}, category {category!r}, view {view!r}; probed were the sites of "
                f"categories {', '.join(self.settings.categories)} in views {', '.join(self.settings.views)}"
            ) from None


def episodes_sha256(run: RunReader) -> str:
    """Identity of the episodes a run holds now."""
    return sha256_json(sorted(run.episodes["episode_id"].astype(str)))


def _score_rows(results: ProbeResults, category: str, view: str, curve: ProbeCurve) -> list[dict[str, Any]]:
    settings, folds, correct = results.settings, curve.folds(), curve.correct
    accuracy, sums = correct.mean(axis=1), curve.sums
    shares, variances = group_shares(sums.sums, sums.sizes)
    count = effective_groups(sums.sizes)
    low, high = wilson_interval(shares, variances, count, sums.n_episodes, max(count - 1, 1.0))
    p, p_fwe, control = pointwise_p(accuracy, curve.null), curve.p_fwe(), curve.control_accuracy
    exceeds = [
        results.controls.exceeds(category, view, str(site), float(p_site))
        for site, p_site in zip(curve.sites, p_fwe, strict=True)
    ]
    return [
        {
            "model": settings.model,
            "random_weights": settings.random_weights,
            "target": settings.target,
            "category": category,
            "view": view,
            "site": str(site),
            "stream": site.stream,
            "part": part,
            "layer": site.layer,
            "depth": curve.depth(site),
            "iteration": site.iteration,
            "accuracy": shares[row],
            "ci_low": low[row],
            "ci_high": high[row],
            "auc": fold_auc(curve.decisions[row], curve.labels, folds),
            "log_loss": float(log_loss(curve.decisions[row], curve.labels)),
            "p": p[row],
            "p_fwe": p_fwe[row],
            "control_accuracy": control[row],
            "selectivity": accuracy[row] - control[row],
            "n": curve.labels.size,
            "items": np.unique(curve.items).size,
            "groups": curve.n_groups,
            "chance": CHANCE,
            "C": " ".join(f"{strength:g}" for strength in curve.strengths[row]),
            "fold_accuracy": " ".join(f"{correct[row, fold.test].mean():.4f}" for fold in folds),
            "settings": settings.key,
            "smallest_p": smallest_p(curve.null.shape[1]),
            "exceeds_random_features": exceeds[row]["random-features"],
            "exceeds_untrained": exceeds[row]["untrained"],
            "signal": has_signal(exceeds[row]),
        }
        for row, (site, part) in enumerate(zip(curve.sites, curve.parts, strict=True))
    ]
