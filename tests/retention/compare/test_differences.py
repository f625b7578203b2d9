import json
from collections.abc import Callable

import pytest

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
    return retention_table({"with VQA": [vqa], "without": [plain]})


def test_a_difference_is_the_first_group_minus_the_second(table: RetentionTable) -> None:
    color, shape, mean = table.differences
    assert [row.category for row in table.differences] == ["color", "shape", "mean"]
    assert (color.group, color.minus, color.view) == ("with VQA", "without", "mean")
    assert color.backbone_accuracy == pytest.approx(0.9 - 0.8)
    assert color.action_accuracy == pytest.approx(0.7 - 0.8)
    assert color.retention == pytest.approx(
        table.rows[0].retention.debiased - table.rows[2].retention.debiased  # type: ignore[operator]
    )
    assert mean.backbone_accuracy == pytest.approx((0.1 + 0.35) / 2)
    assert shape.backbone_ci is not None
    assert shape.backbone_ci[0] is not None
    assert shape.backbone_ci[0] > 0


def test_retention_is_compared_only_where_both_groups_have_it(table: RetentionTable) -> None:
    color, shape, mean = table.differences
    assert shape.retention is None
    assert mean.retention == color.retention


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
    assert table.differences[0].backbone_accuracy == pytest.approx((0.9 + 0.8) / 2 - 0.9)
    assert table.differences[0].paired
    assert [(mean.group, mean.run.model) for mean in table.means] == [
        ("both", "strong"), ("both", "weak"), ("strong", "alone"),
    ]  # fmt: skip
    assert len(table.all_rows) == 2 * 3


def test_every_format_shows_groups_and_differences(table: RetentionTable) -> None:
    content = json.loads(table.to_json())
    assert [row["group"] for row in content["rows"]] == ["with VQA"] * 3 + ["without"] * 3
    assert content["differences"][0]["sr_ci"][0] < 0
    assert "| with VQA − without | color | +0.0 [" in table.to_markdown()
    assert "| with VQA: vqa |" in table.to_markdown()
    assert "with VQA $-$ without & mean & 0 & color" in table.to_latex()
    frame = table.differences_frame()
    assert frame["backbone_accuracy"].round(6).tolist() == [0.1, 0.35, 0.225]
    assert (frame["backbone_ci_low"] < frame["backbone_accuracy"]).all()


def test_keys_follow_the_runs_of_all_groups(probed_run: ProbedRun) -> None:
    run = probed_run({"color": SIGNAL})
    with pytest.raises(UsageError, match="1 keys for 2 runs"):
        retention_table({"a": [run], "b": [run]}, keys=[None])
