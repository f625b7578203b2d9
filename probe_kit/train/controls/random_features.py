"""The control `random-features`: accuracy of an untrained conjunction of picture and word features.

Concepts recur in other groups of pictures, so a probe can itself learn which pixels answer which word, as soon as
its features hold products of both. Any random nonlinear layer does. The control is such a layer, as wide as the
site it is compared with, on the tiles and the words alone; a model that knows more than that must be better.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.hashing import derive_seed
from probe_kit.statistics.estimates.balanced import CHANCE
from probe_kit.statistics.paired_bootstrap import better_than_reference
from probe_kit.train.controls.baselines import Features, tile_pixels, word_counts
from probe_kit.train.crossval.category_problem import CategoryProblem, category_problem
from probe_kit.train.crossval.metrics import correctness
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.data.samples import Samples
from probe_kit.train.results.control_scores import RANDOM_FEATURES, BaselineScore, ControlComparison
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from probe_kit.suite import Suite

SIDE = 12
"""Pixels along a tile: enough for colours and coarse shapes."""
LAYERS = 5
"""Random layers, whose mean is the reference: one alone is lucky or not, and the best of them is lucky."""


@dataclass(frozen=True)
class RandomFeatureInputs:
    """What the random layers see, one row per episode of the run: (E, P) pixels and (E, W) word counts."""

    pixels: Features
    words: Features

    @classmethod
    def of(cls, run: RunReader, suite: "Suite") -> "RandomFeatureInputs":
        """From the run's suite. Raises UsageError without instructions."""
        return cls(tile_pixels(run.episodes, suite, SIDE), word_counts(run))

    def layer(self, rows: NDArray[np.intp], width: int, seed: int) -> Features:
        """(N, width) outputs of a random tanh layer, to which pictures and words give equal shares."""
        return random_layer([self.pixels[rows], self.words[rows]], width, seed)


def random_layer(parts: Sequence[Features], width: int, seed: int) -> Features:
    """(N, width) outputs of a random tanh layer, to which every part (N, D) gives an equal share.

    A part that is the same for all samples, such as the state at the first frame, gives nothing.
    """
    generator = np.random.default_rng(seed)
    varying = [_standardised(part) for part in parts]
    mixed = [
        part @ generator.standard_normal((part.shape[1], width)) / max(1, part.shape[1]) ** 0.5 for part in varying
    ]
    outputs: Features = np.tanh(sum(mixed)).astype(np.float32)
    return outputs


def random_feature_scores(
    results: ProbeResults, run: RunReader, inputs: RandomFeatureInputs
) -> tuple[list[BaselineScore], list[ControlComparison]]:
    """The control's mean accuracy per category, as wide as the backbone, and every site compared with it.

    A site is compared with layers of its own stream's width, on the same folds.
    """
    scores, found = [], []
    for category in results.settings.categories:
        problem = category_problem(run.episodes, category, results.settings)
        references = {
            name: _layer_decisions(inputs, problem, stream.width, results.settings.seed)
            for name, stream in run.streams.items()
        }
        first = references.get("backbone", next(iter(references.values())))
        scores.append(_score(first, problem, category))
        right = {
            name: correctness(decisions, problem.labels[None, :]).mean(axis=0)
            for name, decisions in references.items()
        }
        found += list(_held_against(results, category, right))
    return scores, found


def _layer_decisions(
    inputs: RandomFeatureInputs, problem: CategoryProblem, width: int, seed: int
) -> NDArray[np.float64]:
    """(LAYERS, E) held-out decisions of the probes of the random layers."""
    nothing = np.empty((problem.labels.size, 0), bool)
    layers = (inputs.layer(problem.rows, width, derive_seed("binding", seed, number)) for number in range(LAYERS))
    return np.array([problem.fit(Samples.pooled(layer), nothing).decisions for layer in layers])


def _score(decisions: NDArray[np.float64], problem: CategoryProblem, category: str) -> BaselineScore:
    share = problem.accuracy(decisions)
    return BaselineScore(
        name=RANDOM_FEATURES,
        category=category,
        accuracy=share.value,
        ci=(share.interval().low, share.interval().high),
        p=None,
        chance=CHANCE,
        n=problem.labels.size,
    )


def _held_against(
    results: ProbeResults, category: str, references: dict[str, NDArray[np.float64]]
) -> Iterator[ControlComparison]:
    for (name, view), curve in results.curves.items():
        if name != category:
            continue
        for stream in dict.fromkeys(site.stream for site in curve.sites):
            rows, reference = curve.stream(stream), references[stream]
            seed = derive_seed("binding", results.settings.seed, category, view, stream)
            p = better_than_reference(curve.correct[rows], reference, curve.groups, seed)
            for row, of_site in zip(rows, p, strict=True):
                yield ControlComparison(
                    RANDOM_FEATURES, category, view, str(curve.sites[row]), float(reference.mean()), float(of_site)
                )


def _standardised(columns: Features) -> NDArray[np.float64]:
    """Columns that vary, with mean 0 and deviation 1."""
    values = columns.astype(np.float64)
    spread = values.std(axis=0)
    centred: NDArray[np.float64] = (values - values.mean(axis=0))[:, spread > 0] / spread[spread > 0]
    return centred
