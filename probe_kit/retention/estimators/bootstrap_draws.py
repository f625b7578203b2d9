"""Numbers with their bootstrap draws, so that averages and differences have intervals too."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.hashing import derive_seed
from probe_kit.retention.behaviour.success_rate import shares_of, units_of
from probe_kit.retention.estimators.cross_fit import Crossfit
from probe_kit.retention.estimators.retention import Peak, Retention, backbone_is_known
from probe_kit.statistics.bootstrap import (
    GAINS,
    SHARES,
    Bounds,
    bootstrap_means,
    draw_groups,
    group_means,
    interval,
    units_seed,
    widened,
)
from probe_kit.train.results.probe_curve import ProbeCurve

if TYPE_CHECKING:
    import pandas as pd

Limits = tuple[float | None, float | None]

UNBOUNDED: Limits = (None, None)
TAIL = 0.025
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Estimate:
    """A value and its (B,) bootstrap draws; a draw is NaN where the quantity has no meaning.

    units: seed of the draws, made from the names of what was drawn. Estimates of equal units are paired.
    count: how many units were drawn. each: (count,) the mean of every unit, in the order of their names and NaN in
    one that has none; None for what is no mean. bounds: between which every unit lies.
    """

    value: float
    draws: NDArray[np.float64]
    units: int
    count: int = 1
    each: NDArray[np.float64] | None = None
    bounds: Bounds = SHARES

    def __sub__(self, other: "Estimate") -> "Estimate":
        """Of what is paired, unit by unit."""
        value, count = self.value - other.value, min(self.count, other.count)
        if self.units != other.units:
            return Estimate(value, self.level - other.level, self.units, count, bounds=GAINS)
        each = None if self.each is None or other.each is None else self.each - other.each
        return Estimate(value, self.draws - other.draws, self.units, count, each, GAINS)

    @property
    def wide(self) -> NDArray[np.float64]:
        """The draws with what units may hold that nobody has seen, see `widened`.

        Of what is no mean only draws that all agree have it: they know nothing.
        """
        known, each = ~np.isnan(self.draws), self.each
        if each is None:
            if not known.any() or np.ptp(self.draws[known]) > _ROUNDING:
                return self.draws
            each = np.full(self.count, self.value)
        each, value, wide = each[~np.isnan(each)], np.array([self.value]), self.draws.copy()
        wide[known] = widened(wide[known, None], value, each[:, None], self.units, self.bounds)[:, 0]
        return wide

    @property
    def level(self) -> NDArray[np.float64]:
        """`wide`, with its mean at the value, to be added up with others.

        Where units agree at a bound all that nobody has seen lies on one side. For one number that is an interval;
        of twelve it would be an average that lies beside their average.
        """
        if self.each is None:
            return self.wide
        known = ~np.isnan(self.draws)
        return self.wide - (float(self.wide[known].mean()) - self.value if known.any() else 0.0)

    @property
    def centred(self) -> "Estimate":
        """With the median of the draws at the value.

        A ratio is skewed, so that the average of many drifts away from the average of their estimates, in the
        draws once more than in the estimates themselves.
        """
        known = self.draws[~np.isnan(self.draws)]
        drift = float(np.median(known)) - self.value if known.size else 0.0
        return replace(self, draws=self.draws - drift)

    @property
    def ci(self) -> Limits:
        """95 % percentile interval, with the value in it; without limits if too many draws have no meaning."""
        known = self.wide[~np.isnan(self.draws)]
        if known.size < (1 - TAIL) * self.draws.size:
            return UNBOUNDED
        low, high = interval(known[:, None], np.array([self.value]))
        return float(low[0]), float(high[0])


Estimates = Mapping[str, Estimate]
"""By quantity: `sr`, `backbone_accuracy`, `action_accuracy`, `retention_debiased`, `_bounded`, `_area`."""


def average(estimates: Sequence[Estimate]) -> Estimate:
    """The mean of several, draw by draw."""
    value, units = fmean(estimate.value for estimate in estimates), sorted({one.units for one in estimates})
    count = max(estimate.count for estimate in estimates)
    each = [estimate.each for estimate in estimates if estimate.each is not None]
    if len(units) == 1 and len(each) == len(estimates):
        draws = np.mean([estimate.draws for estimate in estimates], axis=0)
        return Estimate(value, draws, units[0], count, np.mean(each, axis=0), estimates[0].bounds)
    draws = np.mean([estimate.level for estimate in estimates], axis=0)
    if len(each) == len(estimates):
        draws = draws.clip(*estimates[0].bounds)
    return Estimate(value, draws, units[0] if len(units) == 1 else derive_seed(*units), count)


def sr_estimate(episodes: "pd.DataFrame", suite: str) -> Estimate:
    """SR of a table of episodes, whole groups of items drawn."""
    groups = units_of(episodes)
    units = units_seed(groups, suite)
    correct = shares_of(episodes, "correct")[:, None]
    each = group_means(correct, groups)[:, 0]
    return Estimate(float(correct.mean()), bootstrap_means(correct, groups, units)[:, 0], units, each.size, each)


def probe_estimates(
    curve: ProbeCurve, peaks: Mapping[str, Peak], retention: Retention | None, suite: str
) -> dict[str, Estimate]:
    """Accuracy of the best sites, and retention's three estimates where it is defined, whole groups drawn."""
    units = units_seed(curve.groups, suite)
    rows = [curve.sites.index(peak.site) for peak in peaks.values()]
    correct = curve.correct[rows].T
    draws, each = bootstrap_means(correct, curve.groups, units), group_means(correct, curve.groups)
    found = {
        f"{name}_accuracy": Estimate(peak.accuracy, draws[:, column], units, curve.n_groups, each[:, column])
        for column, (name, peak) in enumerate(peaks.items())
    }
    if retention is not None and retention.defined:
        for name in ("debiased", "bounded", "area"):
            fit = retention.fit if name == "debiased" else getattr(retention, f"{name}_fit")
            draws = retention_draws(fit, curve.chance, units)
            found[f"retention_{name}"] = Estimate(getattr(retention, name), draws, units, curve.n_groups)
    return found


def retention_draws(fit: Crossfit, chance: float, units: int) -> NDArray[np.float64]:
    """Retention in every draw of groups. NaN where the backbone is not above chance, and in every draw where its
    score is not known well enough to divide by.

    Groups are drawn with the chosen sites given, so that runs on the same groups stay paired. What choosing adds
    to the covariance is drawn on top, for every run on its own.
    """
    times = draw_groups(fit.sizes.size, units)
    if not backbone_is_known(fit):
        return np.full(len(times), np.nan)
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
