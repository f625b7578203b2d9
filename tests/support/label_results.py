"""Results of label probes with given scores, as `train --labels` would store them."""

from collections.abc import Mapping

import numpy as np

from probe_kit.hooks import Site
from probe_kit.train import ProbeCurve, ProbeResults, ProbeSettings
from tests.support.inner_qualities import inner_of

_PARTS = {"backbone": "backbone", "expert": "action"}


def label_results(
    sites: Mapping[Site, tuple[float, float]],
    groups: int,
    each: int,
    *,
    task: str = "binary",
    window: int = 1,
    permutations: int = 59,
    noise: float = 0.0,
    null_spread: float = 0.0,
    suite: str = "some@1#0",
) -> ProbeResults:
    """Probes whose site has a mean score and a chance, of `each` samples in every group.

    noise: deviation of scores between groups. null_spread: half width of the metrics under permutation.
    """
    draw = np.random.default_rng(0)
    n = groups * each
    scores = np.stack([np.full(n, score) for score, _ in sites.values()])
    shifts = draw.normal(0, noise, (len(sites), groups)) if noise else np.zeros((len(sites), groups))
    scores += np.repeat(shifts - shifts.mean(axis=1, keepdims=True), each, axis=1)
    spread = null_spread * np.linspace(-1, 1, permutations)
    null = np.stack([chance + spread for _, chance in sites.values()])
    chances = np.array([[chance] for _, chance in sites.values()])
    labels = np.tile(np.arange(each) % 2, groups).astype(float)
    names = np.repeat([f"group-{number:03d}" for number in range(groups)], each)
    folds = np.repeat(np.arange(groups) % 5, each)
    curve = ProbeCurve(
        sites=tuple(sites), labels=labels, episodes=np.array([f"episode-{number:04d}" for number in range(n)]),
        items=names, groups=names, fold_of=folds, decisions=np.tile(labels, (len(sites), 1)),
        strengths=np.ones((len(sites), 5)), null=null, inner=inner_of(scores - chances, folds, names),
        parts=tuple(_PARTS[site.stream] for site in sites), task=task, balanced=False,  # type: ignore[arg-type]
        classes=() if task == "continuous" else ("no", "yes"), sample_scores=scores,
        inferences=np.zeros(n, np.int64), smallest_p=1 / (1 + permutations),
    )  # fmt: skip
    settings = ProbeSettings(
        "made", False, None, suite, suite, "0" * 64, "0" * 64, ("all",), ("mean",), "drawer", permutations, 0,
        task=task, label="1" * 64, grouping="2" * 64, window=window,  # type: ignore[arg-type]
    )  # fmt: skip
    return ProbeResults(settings, {("all", "mean"): curve})
