from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
import pytest

from probe_kit.hooks import Site
from probe_kit.train import ArrayRun, ProbeResults, ProbeSettings, train_probes

PlantedRun = Callable[..., ArrayRun]
SETTINGS = ProbeSettings(
    "m", False, None, "s@1#0", "s@1#0", "0", "0", ("color",), ("mean",), "side.correct", permutations=9, seed=0
)


@pytest.fixture
def results(planted_run: PlantedRun) -> ProbeResults:
    return train_probes(planted_run({Site("backbone", 3): 1.0}, categories=("color", "shape")), permutations=9)


def test_scores_follow_from_the_stored_decisions(results: ProbeResults) -> None:
    for (category, view), curve in results.curves.items():
        rows = results.scores[(results.scores["category"] == category) & (results.scores["view"] == view)]
        assert rows["site"].tolist() == [str(site) for site in curve.sites]
        np.testing.assert_array_equal(rows["accuracy"], curve.correct.mean(axis=1))
        np.testing.assert_array_equal(rows["p_fwe"], curve.p_fwe())


def test_fold_accuracies_average_to_the_accuracy(results: ProbeResults) -> None:
    row, curve = results.scores.iloc[3], results.curves["color", "mean"]
    weights = [fold.test.size for fold in curve.folds()]
    per_fold = [float(value) for value in row["fold_accuracy"].split()]
    assert np.average(per_fold, weights=weights) == pytest.approx(row["accuracy"], abs=1e-4)


@pytest.mark.parametrize("name", [name for name in asdict(SETTINGS) if name != "random_weights"])
def test_any_other_setting_is_another_key(name: str) -> None:
    other = {"categories": ("shape",), "views": ("last",), "permutations": 10, "seed": 1, "format": 99}
    assert replace(SETTINGS, **{name: other.get(name, "other")}).key != SETTINGS.key  # type: ignore[arg-type]
