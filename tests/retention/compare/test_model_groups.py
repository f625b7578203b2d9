"""Groups of models: the model is the unit, and the least p that so few allow follows the p."""

from collections.abc import Callable
from io import StringIO

import pytest
from rich.console import Console

from probe_kit.retention import RetentionTable, retention_table
from probe_kit.train import ArrayRun

ProbedRun = Callable[..., ArrayRun]


@pytest.fixture
def table(probed_run: ProbedRun) -> RetentionTable:
    """Three models against three whose backbones are as good; their probes differ by chance alone."""
    names = ("one", "two", "three", "four", "five", "six")
    good = {name: ([0.5, 0.8 + 0.02 * at], [[0.6, 0.7 - 0.02 * at]]) for at, name in enumerate(names)}
    runs = [probed_run({"color": curves, "shape": curves}, name) for name, curves in good.items()]
    return retention_table({"first": runs[:3], "second": runs[3:]})


def test_three_models_against_three_cannot_be_below_one_tenth(table: RetentionTable) -> None:
    assert len(table.differences) == 3
    for row in table.differences:
        for test in (row.sr_models, row.retention_models):
            assert test is not None
            assert (test.n, test.n_minus, test.smallest_p) == (3, 3, pytest.approx(0.1))
            assert test.p >= test.smallest_p - 1e-12


def test_every_format_shows_the_p_over_models_and_the_least_possible_one(table: RetentionTable) -> None:
    console = Console(width=400, file=StringIO())
    console.print(table.to_rich("all"))
    for text in (console.file.getvalue(), table.to_markdown(), table.to_latex(), table._repr_html_()):  # type: ignore[attr-defined]
        assert "over models" in text
        assert "(0.100)" in text


def test_single_runs_have_no_p_over_models(probed_run: ProbedRun) -> None:
    runs = [probed_run({"color": ([0.5, 0.9], [[0.6, 0.7]])}, name) for name in ("one", "two")]
    table = retention_table(runs)
    assert [row.sr_models for row in table.differences] == [None, None]
    assert "over models" not in table.to_markdown()
