"""Rows of the table of scores: one per site, with the columns that its kind of target has."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from probe_kit.hooks.contract.sites import Site
from probe_kit.statistics.estimates.shares import effective_groups, group_shares, wilson_interval
from probe_kit.statistics.label_permutations import pointwise_p
from probe_kit.train.crossval.task_scores import METRICS, fold_auc, fold_spearman, log_loss
from probe_kit.train.results.control_scores import Controls, Exceeds, has_signal
from probe_kit.train.results.probe_curve import Matrix, ProbeCurve
from probe_kit.train.settings import ProbeSettings


def score_rows(
    settings: ProbeSettings, controls: Controls, key: tuple[str, str], curve: ProbeCurve
) -> Iterator[dict[str, Any]]:
    """Yield the row of every site of a curve. key: its category and view. See `ProbeResults.scores`."""
    category, view = key
    score, low, high = _estimates(curve)
    p, p_fwe, chance = pointwise_p(curve.metric, curve.null), curve.p_fwe(), curve.chance
    for row, (site, part) in enumerate(zip(curve.sites, curve.parts, strict=True)):
        exceeds = _exceeds(controls, key, site, float(p_fwe[row]), curve.is_side)
        yield {
            "model": settings.model,
            "random_weights": settings.random_weights,
            "target": settings.target,
            "task": curve.task,
            "category": category,
            "view": view,
            "site": str(site),
            "stream": site.stream,
            "part": part,
            "layer": site.layer,
            "depth": curve.depth(site),
            "iteration": site.iteration,
            "metric": METRICS[curve.task],
            "score": score[row],
            "ci_low": low[row],
            "ci_high": high[row],
            "chance": chance[row],
            "p": p[row],
            "p_fwe": p_fwe[row],
            "smallest_p": curve.least_p,
            **{exceeds_column(name): better for name, better in exceeds.items() if name != "chance"},
            "signal": has_signal(exceeds),
            **(_of_side(curve, row, score[row]) if curve.is_side else _of_label(controls, key, curve, row)),
            "n": curve.labels.size,
            "episodes": np.unique(curve.episodes).size,
            "items": np.unique(curve.items).size,
            "groups": curve.n_groups,
            "settings": settings.key,
        }


def exceeds_column(control: str) -> str:
    """Return the name of the column that says whether a site exceeds a control."""
    return f"exceeds_{control.replace('-', '_')}"


def _estimates(curve: ProbeCurve) -> tuple[Matrix, Matrix, Matrix]:
    """(S,) scores with the ends of their intervals."""
    if curve.is_side:
        sums = curve.sums
        shares, variances = group_shares(sums.sums, sums.sizes)
        count = effective_groups(sums.sizes)
        low, high = wilson_interval(shares, variances, count, sums.n_episodes, max(count - 1, 1.0))
        return shares, low, high
    limits = np.array([curve.estimate(np.array([row]))[1] for row in range(len(curve.sites))])
    return curve.metric, limits[:, 0], limits[:, 1]


def _exceeds(controls: Controls, key: tuple[str, str], site: Site, p_fwe: float, is_side: bool) -> Exceeds:
    exceeds = controls.exceeds(*key, site, p_fwe)
    return {name: better for name, better in exceeds.items() if is_side or name == "chance" or better is not None}


def _of_side(curve: ProbeCurve, row: int, accuracy: float) -> dict[str, Any]:
    correct, control = curve.correct[row], curve.control_accuracy[row]
    return {
        "accuracy": accuracy,
        "auc": fold_auc(curve.decisions[row], curve.labels, curve.folds()),
        "log_loss": float(log_loss(curve.decisions[row], curve.labels)),
        "control_accuracy": control,
        "selectivity": curve.metric[row] - control,
        "C": " ".join(f"{strength:g}" for strength in curve.strengths[row]),
        "fold_accuracy": " ".join(f"{correct[fold.test].mean():.4f}" for fold in curve.folds()),
    }


def _of_label(controls: Controls, key: tuple[str, str], curve: ProbeCurve, row: int) -> dict[str, Any]:
    quantity = curve.task == "continuous"
    return {
        "spearman": fold_spearman(curve.decisions[row], curve.labels, curve.folds()) if quantity else float("nan"),
        "best_control": controls.reference(*key, curve.sites[row]),
        "penalties": " ".join(f"{penalty:g}" for penalty in curve.penalties[row]),
    }
