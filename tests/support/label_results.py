"""Results of label probes with given scores, as `train --labels` would store them."""

from collections.abc import Mapping

import numpy as np

from probe_kit.hooks import Site
from probe_kit.train import LabelResults
from probe_kit.train.labels.label_results import LabelCurve
from probe_kit.train.labels.label_settings import LabelSettings
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
) -> LabelResults:
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
    curve = LabelCurve(
        tuple(sites), tuple(_PARTS[site.stream] for site in sites), np.tile(labels, (len(sites), 1)), scores, null,
        np.ones((len(sites), 5)), inner_of(scores - chances, folds, names),
    )  # fmt: skip
    settings = LabelSettings(
        "made", False, None, suite, suite, "0" * 64, "0" * 64, (), ("mean",), "drawer", task,  # type: ignore[arg-type]
        "1" * 64, "group_id", "all", "2" * 64, window, 0, permutations, 0,
    )  # fmt: skip
    return LabelResults(
        settings=settings,
        classes=() if task == "continuous" else ("no", "yes"),
        labels=labels,
        episodes=np.array([f"episode-{number:04d}" for number in range(n)]),
        inferences=np.zeros(n, np.int64),
        groups=names,
        fold_of=folds,
        curves={"mean": curve},
        smallest_p=1 / (1 + permutations),
    )
