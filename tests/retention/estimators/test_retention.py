from collections.abc import Callable
from math import isnan

import numpy as np
import pandas as pd
import pytest

from probe_kit.errors import UsageError
from probe_kit.hooks import Site
from probe_kit.retention import best_site, measure_retention
from probe_kit.train import ProbeCurve

CurveOf = Callable[..., ProbeCurve]
Outcomes = Callable[..., pd.DataFrame]


@pytest.fixture
def episodes(outcome_table: Outcomes) -> pd.DataFrame:
    return outcome_table(100, 100, 0)


def test_plain_retention_is_the_ratio_of_the_best_accuracies_above_chance(
    curve_of: CurveOf, episodes: pd.DataFrame
) -> None:
    found = measure_retention(curve_of(episodes, [0.5, 0.9, 0.7], [[0.55, 0.6], [0.7, 0.6]]))
    assert found is not None
    assert found.defined
    assert found.plain == pytest.approx(0.2 / 0.4)
    assert found.backbone.site == Site("backbone", 1)
    assert found.expert.site == Site("expert", 0, "residual", 1)
    assert found.interval.low < found.debiased < found.interval.high


def test_the_last_or_one_iteration_can_be_asked_for(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    curve = curve_of(episodes, [0.9], [[0.8, 0.5], [0.6, 0.7]])
    for iterations, accuracy in (("all", 0.8), ("last", 0.7), (0, 0.8)):
        peak = best_site(curve, "expert", iterations)  # type: ignore[arg-type]
        assert peak is not None
        assert peak.accuracy == accuracy
    with pytest.raises(UsageError, match="iterations 0 to 1, not 2"):
        best_site(curve, "expert", 2)


def test_without_backbone_signal_retention_is_not_defined_but_kept(
    curve_of: CurveOf, episodes: pd.DataFrame
) -> None:
    found = measure_retention(curve_of(episodes, [0.55, 0.56], [[0.58]], null_top=0.6))
    assert found is not None
    assert not found.defined
    assert found.note == "n/a (no backbone signal)"
    assert found.plain == pytest.approx(0.08 / 0.06)


def test_without_relabellings_retention_is_not_defined(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    curve = curve_of(episodes, [0.9], [[0.8]])
    bare = ProbeCurve(**{**vars(curve), "null": np.empty((2, 0))})
    found = measure_retention(bare)
    assert found is not None
    assert (found.defined, found.note) == (False, "n/a (no permutations)")


def test_a_backbone_exactly_at_chance_has_no_ratio(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    found = measure_retention(curve_of(episodes, [0.5], [[0.6]]))
    assert found is not None
    assert isnan(found.plain)
    assert not found.interval.bounded


def test_a_curve_without_expert_has_no_retention(curve_of: CurveOf, episodes: pd.DataFrame) -> None:
    assert measure_retention(curve_of(episodes, [0.9], [])) is None


def test_action_tokens_take_the_place_of_an_expert_that_is_not_there(
    curve_of: CurveOf, episodes: pd.DataFrame
) -> None:
    accuracies = [0.5, 0.9, 0.7], [[0.55, 0.6], [0.7, 0.6]]
    found = measure_retention(curve_of(episodes, *accuracies, action_stream="action"))
    same = measure_retention(curve_of(episodes, *accuracies))
    assert found is not None
    assert same is not None
    assert found.expert.site == Site("action", 0, "residual", 1)
    assert (found.plain, found.debiased) == (same.plain, same.debiased)
    with pytest.raises(UsageError, match="stream action has iterations 0 to 1"):
        measure_retention(curve_of(episodes, *accuracies, action_stream="action"), 2)
