"""Numbers with their bootstrap draws, so that averages and differences have intervals too."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.identity import derive_seed
from probe_kit.retention.crossfit import Crossfit
from probe_kit.retention.measure import Peak, Retention
from probe_kit.train.curve import Curve
from probe_kit.train.scores import bootstrap_means, draw_groups

if TYPE_CHECKING:
    import pandas as pd

Limits = tuple[float | None, float | None]

UNBOUNDED: Limits = (None, None)
TAIL = 0.025


@dataclass(frozen=True)
class Estimate:
    """A value and its (B,) bootstrap draws; a draw is NaN where the quantity has no meaning.

    units: seed of the draws, made from the names of what was drawn. Estimates of equal units are paired.
    """

    value: float
    draws: NDArray[np.float64]
    units: int

    def __sub__(self, other: "Estimate") -> "Estimate":
        return Estimate(self.value - other.value, self.draws - other.draws, self.units)

    @property
    def ci(self) -> Limits:
        """95 % percentile interval; without limits if too many draws have no meaning."""
        if np.isnan(self.draws).mean() > TAIL:
            return UNBOUNDED
        low, high = np.nanpercentile(self.draws, [100 * TAIL, 100 * (1 - TAIL)])
        return float(low), float(high)


Estimates = Mapping[str, Estimate]
"""Estimates by quantity: `sr`, `prefix_accuracy`, `action_accuracy`, `retention_debiased`."""


def average(estimates: Sequence[Estimate]) -> Estimate:
    """The mean of several, draw by draw."""
    draws = np.mean([estimate.draws for estimate in estimates], axis=0)
    units = sorted({estimate.units for estimate in estimates})
    return Estimate(fmean(e.value for e in estimates), draws, units[0] if len(units) == 1 else derive_seed(*units))


def sr_estimate(episodes: "pd.DataFrame", suite: str, seed: int) -> Estimate:
    """SR of a table of episodes, whole items drawn."""
    units = _units(episodes["item_id"].to_numpy(dtype=str), suite, seed)
    correct = (episodes["outcome"] == "correct").to_numpy()
    draws = bootstrap_means(correct[:, None], episodes["item_id"].to_numpy(dtype=str), units)
    return Estimate(float(correct.mean()), draws[:, 0], units)


def probe_estimates(
    curve: Curve, peaks: Mapping[str, Peak], retention: Retention | None, suite: str, seed: int
) -> dict[str, Estimate]:
    """Accuracy of the best sites, and debiased retention where it is defined, whole groups drawn."""
    units = _units(curve.groups, suite, seed)
    rows = [curve.sites.index(peak.site) for peak in peaks.values()]
    draws = bootstrap_means(curve.correct[rows].T, curve.groups, units)
    found = {
        f"{name}_accuracy": Estimate(peak.accuracy, draws[:, column], units)
        for column, (name, peak) in enumerate(peaks.items())
    }
    if retention is not None and retention.defined:
        ratios = retention_draws(retention.fit, curve.chance, units)
        found["retention_debiased"] = Estimate(retention.debiased, ratios, units)
    return found


def retention_draws(fit: Crossfit, chance: float, units: int) -> NDArray[np.float64]:
    """Debiased retention in every draw of groups. NaN where the backbone is not above chance.

    Groups are drawn with the chosen sites given, so that runs on the same groups stay paired. What choosing adds
    to the covariance is drawn on top, for every run on its own.
    """
    times = draw_groups(fit.sizes.size, units)
    scored = (times @ fit.held_out.T / (times @ fit.sizes)[:, None]).T - chance
    own = np.random.default_rng(derive_seed("choosing", units, fit.held_out.tobytes().hex()))
    expert, backbone = scored + _root(fit.covariance - fit.scoring) @ own.standard_normal(scored.shape)
    ratios: NDArray[np.float64] = np.full(backbone.shape, np.nan)
    np.divide(expert, backbone, where=backbone > 0, out=ratios)
    return ratios


def _root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """A square root of the nearest covariance without negative parts."""
    values, vectors = np.linalg.eigh(covariance)
    root: NDArray[np.float64] = vectors * np.sqrt(values.clip(min=0))
    return root


def _units(names: ArrayLike, suite: str, seed: int) -> int:
    return derive_seed("units", seed, suite, *np.unique(np.asarray(names)).tolist())
