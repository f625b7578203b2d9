import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from probe_kit.errors import UsageError
from probe_kit.retention import RetentionTable, retention_table
from probe_kit.train import ArrayRun

ProbedRun = Callable[..., ArrayRun]

SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7]])
WEAK = ([0.5, 0.8, 0.6], [[0.5, 0.8]])
NONE = ([0.5, 0.55, 0.5], [[0.58, 0.5]])


@pytest.fixture
def table(probed_run: ProbedRun) -> RetentionTable:
    vqa = probed_run({"color": SIGNAL, "shape": SIGNAL}, "vqa")
    plain = probed_run({"color": WEAK, "shape": NONE}, "plain")
    return retention_table({"without": [plain], "with VQA": [vqa]})


def test_a_difference_is_the_later_group_minus_the_earlier(table: RetentionTable) -> None:
    color, shape, mean = table.differences
    assert [row.category for row in table.differences] == ["color", "shape", "mean"]
    assert (color.group, color.minus, color.view) == ("with VQA", "without", "mean")
    other, weaker, one, _ = table.rows
    assert color.backbone == pytest.approx(0.9 - 0.8, abs=1e-3)
    assert color.action == pytest.approx(one.action.score - other.action.score)  # type: ignore[operator]
    assert color.retention == pytest.approx(one.retention.value - other.retention.value)  # type: ignore[operator]
    assert weaker.backbone.score is not None
    assert mean.backbone == pytest.approx((0.1 + 0.9 - weaker.backbone.score) / 2, abs=1e-3)
    assert shape.backbone_ci is not None
    assert shape.backbone_ci[0] is not None
    assert shape.backbone_ci[0] > 0


def test_retention_is_compared_only_where_both_groups_have_it(table: RetentionTable) -> None:
    color, shape, mean = table.differences
    assert (shape.retention, shape.retention_ci) == (None, None)
    assert color.retention is not None
    second, first = (row.retention.value for row in table.means)
    assert mean.retention == pytest.approx(first - second)  # type: ignore[operator]
    assert mean.retention_ci is not None
    assert mean.retention_ci[0] < mean.retention < mean.retention_ci[1]  # type: ignore[operator]


def test_equal_behaviour_on_the_same_items_is_no_proof_of_equality(table: RetentionTable) -> None:
    """Of 100 items that all agree, 3 % unlike them would not have been missed."""
    for row in table.differences:
        assert row.paired
        assert row.sr == 0.0
        low, high = row.sr_ci
        assert low == pytest.approx(-0.03, abs=0.011)
        assert high == pytest.approx(0.03, abs=0.011)


def test_other_suites_are_compared_without_pairing(probed_run: ProbedRun) -> None:
    one = probed_run({"color": SIGNAL}, "one")
    other = probed_run({"color": SIGNAL}, "other", suite="other@1#ba9876543210")
    row = retention_table({"a": [one], "b": [other]}).differences[0]
    assert not row.paired
    assert row.p is None
    assert row.sr == 0.0
    assert row.sr_ci[0] is not None
    assert row.sr_ci[0] < -0.05


def test_a_group_is_the_mean_of_its_runs(probed_run: ProbedRun) -> None:
    strong, weak = probed_run({"color": SIGNAL}, "strong"), probed_run({"color": WEAK}, "weak")
    alone = probed_run({"color": SIGNAL}, "alone")
    table = retention_table({"both": [strong, weak], "strong": [alone]})
    assert table.differences[0].backbone == pytest.approx(0.9 - (0.9 + 0.8) / 2, abs=1e-3)
    assert table.differences[0].paired
    assert [(mean.group, mean.run.model) for mean in table.means] == [
        ("both", "strong"), ("both", "weak"), ("strong", "alone"),
    ]  # fmt: skip
    assert len(table.all_rows) == 2 * 3


def test_every_format_shows_groups_and_differences(table: RetentionTable) -> None:
    content = json.loads(table.to_json())
    assert [row["group"] for row in content["rows"]] == ["without"] * 3 + ["with VQA"] * 3
    assert content["differences"][0]["sr_ci"][0] < 0
    assert "| Color | with VQA − without | +0.0 [" in table.to_markdown()
    assert "| Color | with VQA: vqa |" in table.to_markdown()
    assert "Color & with VQA $-$ without & " in table.to_latex("all")
    frame = table.differences_frame()
    assert frame["backbone"].tolist() == [row.backbone for row in table.differences]
    assert frame["backbone"][0] == pytest.approx(0.1, abs=1e-3)
    assert (frame["backbone_ci_low"] < frame["backbone"]).all()


def test_keys_follow_the_runs_of_all_groups(probed_run: ProbedRun) -> None:
    run = probed_run({"color": SIGNAL})
    with pytest.raises(UsageError, match="1 keys for 2 runs"):
        retention_table({"a": [run], "b": [run]}, keys=[None])


# -- models as the unit --------------------------------------------------------------------------------------


def test_groups_of_models_have_a_p_over_models_and_the_least_that_so_few_allow(probed_run: ProbedRun) -> None:
    """Three against three cannot be below 0.1, whatever their questions say."""
    groups = {
        name: [probed_run({"color": ([0.5, 0.95], [[top + 0.02 * at]])}, f"{name}{at}") for at in range(3)]
        for name, top in (("high", 0.85), ("low", 0.65))
    }
    table = retention_table(groups)
    color, mean = table.differences
    own = {row.run.model: row.retention.value for row in table.rows}
    values = [[float(own[f"{name}{at}"] or 0) for at in range(3)] for name in groups]
    for row in (color, mean):
        found = row.retention_models
        assert found is not None
        assert (found.n, found.n_minus) == (3, 3)
        assert found.p == pytest.approx(0.1), "the most extreme of 20 ways, either way round"
        assert found.smallest_p == pytest.approx(0.1)
        assert found.difference == pytest.approx(np.mean(values[1]) - np.mean(values[0]))
        welch = stats.ttest_ind(*values[::-1], equal_var=False).confidence_interval()
        assert found.ci == pytest.approx((welch.low, welch.high))
    assert color.sr_models is not None
    assert (color.sr_models.p, color.sr_models.difference) == (1, 0), "all did the same"


def test_a_single_model_against_another_has_no_p_over_models(table: RetentionTable) -> None:
    assert all(row.sr_models is None and row.retention_models is None for row in table.differences)


def test_a_group_with_a_model_without_probes_has_no_p_of_retention(probed_run: ProbedRun, tmp_path: Path) -> None:
    one, other = (probed_run({"color": SIGNAL}, name) for name in ("one", "other"))
    bare = ArrayRun(tmp_path / "bare", "bare", one.suite, one.episodes, {})
    rows = retention_table({"b": [bare], "a": [one, other]}).differences
    assert all(row.retention is None and row.retention_models is None for row in rows)
    assert all(row.sr_models is not None and row.sr_models.n_minus == 1 for row in rows)
