import re
from collections.abc import Callable

import pytest

from probe_kit.retention import RetentionTable, retention_table
from probe_kit.train import ArrayRun


@pytest.fixture
def table(probed_run: Callable[..., ArrayRun]) -> RetentionTable:
    accuracies = {"color": ([0.5, 0.9, 0.7], [[0.6, 0.7]]), "counting": ([0.5, 0.55, 0.5], [[0.58, 0.5]])}
    return retention_table([probed_run(accuracies, "pi0-tiny", random_weights=True)])


def test_titles_and_rows_mark_random_weights(table: RetentionTable) -> None:
    text = table.to_markdown()
    assert text.count("(suite@1#0123456789ab; random weights)") == 2
    assert text.count("| pi0-tiny (random weights) |") == 6


def test_undefined_retention_says_why(table: RetentionTable) -> None:
    most = table.rows[1].backbone.at_most
    assert most is not None
    assert table.to_markdown().count("| n/a | – |") == 1
    assert f"n/a (backbone absent, at most {100 * most:.0f} %): counting." in table.to_markdown()


def test_rows_have_as_many_cells_as_the_heading(table: RetentionTable) -> None:
    tables = re.findall(r"(?:^\|.*\n)+", table.to_markdown(), re.MULTILINE)
    assert len(tables) == 3
    for one in tables:
        assert len({line.count("|") for line in one.splitlines()}) == 1


def test_success_rates_are_listed_once_however_many_views(table: RetentionTable) -> None:
    twice = RetentionTable(table.rows * 2, table.means)
    assert twice.to_markdown().split("**Retention")[0].count("| color |") == 1
