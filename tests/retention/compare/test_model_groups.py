"""Groups of models: the model is the unit, and the least p that so few allow follows the p."""

from collections.abc import Callable
from dataclasses import replace
from io import StringIO

import pytest
from rich.console import Console

from probe_kit._tables.numbers import points, signed
from probe_kit.errors import UsageError
from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.columns.text import models_test
from probe_kit.retention.compare.compare import ModelTest
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
    for text in (console.file.getvalue(), table.to_markdown(), table.to_latex("all"), table._repr_html_()):  # type: ignore[attr-defined]
        assert "over models" in text
        assert "(0.100)" in text


def test_runs_of_one_model_are_no_further_models(probed_run: ProbedRun) -> None:
    """Seeds of two models against seeds of two others: four models, whatever the number of seeds."""
    runs = [
        replace(probed_run({"color": ([0.5, 0.7 + 0.02 * at], [[0.6, 0.7]])}, f"run {at}"), weights_sha256=model)
        for at, model in enumerate("aaabbbcccddd")
    ]
    for row in retention_table({"first": runs[:6], "second": runs[6:]}).differences:
        assert row.sr_models is not None
        assert (row.sr_models.n, row.sr_models.n_minus, row.sr_models.smallest_p) == (2, 2, pytest.approx(1 / 3))
    again = replace(runs[6], weights_sha256="b")
    both = retention_table({"first": runs[:6], "second": [again, *runs[7:]]}).differences
    assert [row.sr_models for row in both] == [None, None], "a model on both sides cannot change sides"


def sisters(probed_run: ProbedRun) -> list[ArrayRun]:
    """Six models with weights of their own."""
    return [
        replace(probed_run({"color": ([0.5, 0.7 + 0.02 * at], [[0.6, 0.7]])}, f"run {at}"), weights_sha256=model)
        for at, model in enumerate("abcdef")
    ]


def test_models_of_one_origin_are_averaged_first(probed_run: ProbedRun) -> None:
    runs = sisters(probed_run)
    origins = {str(run.location): origin for run, origin in zip(runs[:3], ("base", "base", "other"), strict=True)}
    row = retention_table({"first": runs[:3], "second": runs[3:]}, origins=origins).differences[0]
    alone = retention_table({"first": runs[:3], "second": runs[3:]}).differences[0]
    assert row.sr_models is not None
    assert alone.retention_models is not None
    assert row.retention_models is not None
    assert (row.sr_models.n, row.sr_models.n_minus) == (3, 2)
    assert (alone.retention_models.n, alone.retention_models.n_minus) == (3, 3)
    assert row.retention_models.difference != alone.retention_models.difference, "two sisters weigh as one model"


def test_checkpoints_of_one_training_are_one_model(probed_run: ProbedRun) -> None:
    runs = sisters(probed_run)
    for run, folder in zip(
        runs, ("m/a/020000", "m/a/040000", "m/b/020000", "m/c/1", "m/d/1", "m/e/1"), strict=True
    ):
        certificate = {"policy": {"checkpoint": f"{folder}/pretrained_model"}}
        object.__setattr__(run, "certificate", certificate)
    row = retention_table({"first": runs[:3], "second": runs[3:]}).differences[0]
    assert row.sr_models is not None
    assert (row.sr_models.n, row.sr_models.n_minus) == (3, 2)


def test_an_origin_of_no_run_is_refused(probed_run: ProbedRun) -> None:
    runs = sisters(probed_run)
    with pytest.raises(UsageError, match="an origin is declared of elsewhere; expected one of the runs"):
        retention_table({"first": runs[:3], "second": runs[3:]}, origins={"elsewhere": "base"})


def test_a_smaller_group_with_a_larger_spread_has_an_interval_and_no_p() -> None:
    few, many = [0.2, 0.6, 0.9], [0.5, 0.51, 0.52, 0.5, 0.49, 0.5]
    test = ModelTest.of(few, many)
    assert test is not None
    assert (test.p, test.smallest_p) == (None, None)
    assert models_test(test, signed).startswith("– ")
    other = ModelTest.of(many, [*few[:2], 0.5, 0.55, 0.45, 0.5])
    assert other is not None
    assert other.p is not None, "groups of equal size exchange whatever their spreads"


def test_single_runs_have_no_p_over_models(probed_run: ProbedRun) -> None:
    runs = [probed_run({"color": ([0.5, 0.9], [[0.6, 0.7]])}, name) for name in ("one", "two")]
    table = retention_table(runs)
    assert [row.sr_models for row in table.differences] == [None, None]
    assert "over models" not in table.to_markdown()


@pytest.mark.parametrize(
    ("first", "second", "written"),
    [
        ([0.0, 1.0], [0.4, 0.9], "–"),  # Welch: −9 to +9 times all that rates can differ by
        ([0.9, 1.0], [0.4], "+100.0]"),
        ([0.9, 0.91, 0.92], [0.5, 0.51, 0.52], "+42.3]"),
    ],
)
def test_an_interval_of_rates_stays_within_a_hundred_points(
    first: list[float], second: list[float], written: str
) -> None:
    test = ModelTest.of(first, second, largest=1.0)
    assert test is not None
    assert models_test(test, points).endswith(f" {written}")
    assert all(limit is None or abs(limit) <= 1 for limit in test.ci)


def test_rates_of_a_table_are_given_their_bound(probed_run: ProbedRun) -> None:
    """Two models and one: their retention can differ by any amount, their success rates cannot."""
    runs = []
    for name, wrong in (("one", 200), ("two", 0), ("three", 100)):
        runs.append(run := probed_run({"color": ([0.5, 0.8], [[0.6, 0.7]])}, name))
        run.episodes["outcome"] = ["wrong"] * wrong + ["correct"] * (len(run.episodes) - wrong)
    (row, *_) = retention_table({"first": runs[:2], "second": runs[2:]}).differences
    assert row.sr_models is not None
    assert row.sr_models.ci == (None, None)
