import json
from collections.abc import Callable

import numpy as np
import pytest

from probe_kit.retention import RetentionTable, retention_table
from probe_kit.train import ArrayRun

SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7]])
NONE = ([0.5, 0.55, 0.5], [[0.58, 0.5]])


@pytest.fixture
def table(probed_run: Callable[..., ArrayRun]) -> RetentionTable:
    return retention_table([probed_run({"color": SIGNAL, "shape": SIGNAL, "counting": NONE})])


def test_the_mean_of_categories_is_known_better_than_one_of_them(table: RetentionTable) -> None:
    (mean,) = table.means
    for part in ("success", "backbone", "action"):
        widths = [limits[1] - limits[0] for row in table.rows for limits in [getattr(row, part).ci]]
        low, high = getattr(mean, part).ci
        assert high - low == pytest.approx(np.sqrt(np.mean(np.square(widths)) / 3), rel=0.15)
    assert mean.success.ci is not None
    assert mean.success.ci[0] < mean.success.sr < mean.success.ci[1]


def test_mean_retention_is_over_all_categories_and_known_better_than_one_of_them(table: RetentionTable) -> None:
    (mean,) = table.means
    assert mean.left_out == ("counting",), "of the published ratios"
    scores = [[part.score - 0.5 for part in (row.action, row.backbone)] for row in table.rows]
    assert mean.retention.value == pytest.approx(np.divide(*np.mean(scores, axis=0)))
    low, high = mean.retention.ci
    of_one = table.rows[0].retention.ci
    assert low < mean.retention.value < high
    assert high - low < of_one[1] - of_one[0]


def test_a_mean_has_limits_where_a_category_of_it_has_none(table: RetentionTable) -> None:
    """The mean backbone is known well enough to divide by."""
    assert table.rows[2].retention.ci == (None, None)
    assert None not in table.means[0].retention.ci


def test_the_mean_of_one_category_is_that_category(probed_run: Callable[..., ArrayRun]) -> None:
    row, mean = retention_table([probed_run({"color": SIGNAL})]).all_rows
    assert mean.retention.value == row.retention.value
    assert mean.retention.published == row.retention.published
    for part in ("success", "backbone", "action", "retention"):
        assert getattr(mean, part).ci == pytest.approx(getattr(row, part).ci), part


def test_selectivity_is_the_peak_above_the_permuted_probes(table: RetentionTable) -> None:
    row = json.loads(table.to_json())[0]
    assert row["backbone"]["selectivity"] == pytest.approx(0.9 - 0.5)  # the fixture's null is centred on one half
    assert row["action"]["selectivity"] == pytest.approx(0.7 - 0.5)
