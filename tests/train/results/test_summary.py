"""The best sites in a few columns, ties and first iteration included."""

import pandas as pd
import pytest

from probe_kit.train.results.summary import best_sites, site_cells


@pytest.fixture
def scores() -> pd.DataFrame:
    sites = [
        ("backbone", 0, None, 0.5), ("backbone", 1, None, 0.9), ("backbone", 2, None, 0.9),
        ("expert", 0, 0, 0.6), ("expert", 1, 0, 0.55), ("expert", 0, 1, 0.8), ("expert", 1, 1, 0.7),
    ]  # fmt: skip
    rows = [
        {
            "category": "color", "view": "mean", "stream": stream, "iteration": step, "accuracy": accuracy,
            "n": 40, "site": f"{stream}.{layer:02d}", "ci_low": accuracy - 0.1,
            "ci_high": accuracy + 0.1, "p_fwe": 0.005,
        }
        for stream, layer, step, accuracy in sites
    ]  # fmt: skip
    return pd.DataFrame(rows).astype({"iteration": "Int64"})


def test_the_first_of_the_best_is_named_with_its_ties_and_the_first_iteration(scores: pd.DataFrame) -> None:
    backbone, expert = (row for _, row in best_sites(scores).iterrows())
    assert site_cells(backbone) == ("backbone.01 +1", "90.0 [80.0, 100.0]", "–", "0.005")
    assert site_cells(expert) == ("expert.00", "80.0 [70.0, 90.0]", "60.0", "0.005")


def test_categories_and_views_do_not_mix(scores: pd.DataFrame) -> None:
    other = scores.assign(category="shape", accuracy=scores["accuracy"] - 0.2)
    found = best_sites(pd.concat([scores, other], ignore_index=True))
    assert found["accuracy"].round(2).tolist() == [0.9, 0.8, 0.7, 0.6]
    assert found["ties"].tolist() == [1, 0, 1, 0]
    assert found["first"].dropna().round(2).tolist() == [0.6, 0.4]
