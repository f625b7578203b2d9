"""A stored comparison is with the network of the file if the network's probes have its accuracy at its site."""

from dataclasses import replace

import numpy as np

from probe_kit.hooks.contract.sites import Site
from probe_kit.study.plan import is_of_network
from probe_kit.train.results.control_scores import UntrainedScore
from probe_kit.train.results.probe_curve import ProbeCurve

LAYERS = 3


def curve(layers: int = LAYERS) -> ProbeCurve:
    """Decisions about 8 episodes, of which layer n has n + 1 right."""
    labels, names = np.tile([True, False], 4), np.arange(8).astype(str)
    right = np.arange(8) <= np.arange(layers)[:, None]
    return ProbeCurve(
        sites=tuple(Site("backbone", layer) for layer in range(layers)), labels=labels, episodes=names,
        items=names, groups=names, fold_of=np.arange(8) % 4, decisions=np.where(right == labels, 1.0, -1.0),
        strengths=np.ones((layers, 4)), null=np.full((layers, 9), 0.5), inner=np.zeros((layers, 4, 8), np.float32),
    )  # fmt: skip


def test_a_network_without_the_site_or_category_of_a_comparison_is_another_one() -> None:
    site = str(curve().sites[LAYERS - 1])
    score = UntrainedScore(
        "color", "mean", site, site, False, 1.0, LAYERS / 8, 1 - LAYERS / 8, (0.5, 0.7), "tiny (random weights)"
    )
    assert is_of_network(score, {("color", "mean"): curve()})
    assert not is_of_network(replace(score, untrained_accuracy=0.5), {("color", "mean"): curve()})
    assert not is_of_network(score, {("color", "mean"): curve(LAYERS - 1)})
    assert not is_of_network(score, {("shape", "mean"): curve()})
