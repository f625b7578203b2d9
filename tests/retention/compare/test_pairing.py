"""Runs and groups of models compared: which are paired, on which items, and the tests of their differences."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from io import StringIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from scipy import stats

from probe_kit._tables.numbers import points, with_sign
from probe_kit.errors import UsageError
from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.behaviour import TableRun, distinct_labels
from probe_kit.retention.columns.text import models_test
from probe_kit.retention.compare.compare import Difference, ModelTest
from probe_kit.retention.compare.models import origins_of
from probe_kit.train import ArrayRun, load_results, save_results
from tests.retention.asked_runs import SUITE, SaidRun, answer_run, episodes
from tests.retention.paired_limits import mover

ProbedRun = Callable[..., ArrayRun]
Hits = dict[str, np.ndarray[Any, np.dtype[np.bool_]]]
SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7]])
WEAK = ([0.5, 0.8, 0.6], [[0.5, 0.8]])


def hits(share: float, seed: int, items: Mapping[str, int] | None = None) -> Hits:
    """Per category (N, 2), whether each item is right in each layout."""
    draw = np.random.default_rng(seed)
    return {name: draw.random((count, 2)) < share for name, count in (items or {"color": 20, "shape": 24}).items()}


def run(folder: Path, right: Hits, suite: str = SUITE, called: str = "", **settings: object) -> SaidRun:
    """A policy run in a folder of its own."""
    return SaidRun(folder, folder.name, suite, episodes(right), {}, settings=settings, called=called)


def difference(table: RetentionTable, side: str, category: str) -> Difference:
    """The difference of this category that `side` is the minuend or the subtrahend of."""
    (matching,) = [row for row in table.differences if side in (row.group, row.minus) and row.category == category]
    return matching


# -- against an oracle of its own ----------------------------------------------------------------------------


def oracle(gains: pd.Series, groups: pd.Series) -> tuple[float, float, float, float]:
    """Mean gain, its interval by a plain loop over draws of groups, and p by trying every flip of their signs."""
    names = sorted(set(groups))
    of_group = {name: gains[groups == name].to_numpy(float) for name in names}
    draw = np.random.default_rng(99)
    means = []
    for _ in range(4000):
        drawn = [of_group[names[at]] for at in draw.integers(len(names), size=len(names))]
        means.append(np.concatenate(drawn).mean())
    low, high = np.quantile(means, [0.025, 0.975])
    sums = [values.sum() for values in of_group.values() if values.sum()]
    observed = abs(sum(sums))
    flips = [
        abs(sum(sign * group_sum for sign, group_sum in zip(signs, sums, strict=True)))
        for signs in product((1, -1), repeat=len(sums))
    ]
    return (
        float(gains.mean()),
        float(low),
        float(high),
        float(np.mean([flipped >= observed - 1e-9 for flipped in flips])),
    )


def test_a_success_rate_less_another_is_what_a_plain_loop_over_groups_says(tmp_path: Path) -> None:
    first, other = run(tmp_path / "one", hits(0.8, 0)), run(tmp_path / "other", hits(0.5, 1))
    table = retention_table([other, first])
    for category in ("color", "shape"):
        mine, theirs = (r.episodes[r.episodes["category"] == category].reset_index() for r in (first, other))
        gains = (mine["outcome"] == "correct").astype(float) - (theirs["outcome"] == "correct")
        value, low, high, p = oracle(gains, mine["group_id"])
        row = difference(table, "other", category)
        assert (row.group, row.paired) == ("one", True)
        assert row.sr == pytest.approx(value)
        assert row.sr_ci == pytest.approx(mover(mine, theirs))
        assert row.sr_ci is not None
        assert row.sr_ci[0] < low + 0.03 < high - 0.03 < row.sr_ci[1]  # type: ignore[operator]
        assert row.p == pytest.approx(p)


@pytest.mark.slow
def test_an_accuracy_less_another_is_what_a_plain_loop_over_groups_says(probed_run: ProbedRun) -> None:
    first, other = probed_run({"color": SIGNAL}, "one"), probed_run({"color": WEAK}, "other")
    row = difference(retention_table([other, first]), "other", "color")
    best = []
    for probed in (first, other):
        curve = load_results(probed).curves["color", "mean"]
        backbone = [at for at, site in enumerate(curve.sites) if site.stream == "backbone"]
        right = (curve.decisions[backbone] > 0) == curve.labels
        best.append(right[right.mean(axis=1).argmax()].astype(float))
    value, low, high, _ = oracle(pd.Series(best[0] - best[1]), pd.Series(curve.groups))
    assert row.backbone == pytest.approx(value, abs=1e-3)
    assert row.backbone_ci == (pytest.approx(low, abs=0.015), pytest.approx(high, abs=0.015))


def test_pairing_makes_intervals_narrower_where_runs_agree(tmp_path: Path) -> None:
    items = {"color": 400, "shape": 24}
    right, other = hits(0.5, 0, items), hits(0.5, 1, items)
    nearly = {name: array.copy() for name, array in right.items()}
    nearly["color"][0, 0] ^= True
    table = retention_table(
        [
            run(tmp_path / name, outcomes)
            for name, outcomes in (("one", right), ("nearly", nearly), ("other", other))
        ]
    )
    widths = []
    for name in ("nearly", "other"):
        low, high = difference(table, name, "color").sr_ci or (0, 0)
        widths.append((high or 0) - (low or 0))
    assert widths[0] < 0.6 * widths[1]


def test_holm_holds_over_all_categories_of_all_pairs(tmp_path: Path) -> None:
    runs = [run(tmp_path / f"run-{seed}", hits(0.9 - 0.2 * seed, seed)) for seed in range(3)]
    rows = retention_table(runs).differences
    for means in (False, True):
        family = sorted((row for row in rows if (row.category == "mean") == means), key=lambda row: row.p or 0)
        assert len(family) == (2 if means else 4)
        highest = 0.0
        for rank, row in enumerate(family):
            assert row.p is not None
            highest = max(highest, min(1.0, (len(family) - rank) * row.p))
            assert row.p_holm == pytest.approx(highest)


def test_a_group_of_runs_is_tested_by_its_mean_on_the_same_items(tmp_path: Path) -> None:
    first, second, third = (run(tmp_path / name, hits(0.7, at)) for at, name in enumerate("abc"))
    table = retention_table({"one": [third], "two": [first, second]})
    right = [(r.episodes["outcome"] == "correct").astype(float) for r in (first, second, third)]
    of_color = first.episodes["category"] == "color"
    gains = ((right[0] + right[1]) / 2 - right[2])[of_color]
    value, _, _, p = oracle(gains, first.episodes["group_id"][of_color])
    row = difference(table, "one", "color")
    assert (row.sr, row.p) == (pytest.approx(value), pytest.approx(p))
    assert row.run is None


# -- which are compared --------------------------------------------------------------------------------------


def pairs(table: RetentionTable) -> list[tuple[str, str]]:
    return list(dict.fromkeys((row.group, row.minus) for row in table.differences))


@pytest.mark.slow
def test_every_other_run_is_compared_with_the_first_or_with_the_one_named(tmp_path: Path) -> None:
    runs = [run(tmp_path / name, hits(0.5, at)) for at, name in enumerate("abc")]
    assert pairs(retention_table(runs)) == [("b", "a"), ("c", "a")]
    assert pairs(retention_table(runs, against="b")) == [("a", "b"), ("c", "b")]
    assert pairs(retention_table(runs, against=str(tmp_path / "c"))) == [("a", "c"), ("b", "c")]
    groups = {"x": runs[:1], "y": runs[1:2], "z": runs[2:]}
    assert pairs(retention_table(groups)) == [("y", "x"), ("z", "x"), ("z", "y")]
    assert pairs(retention_table(groups, against="y")) == [("x", "y"), ("z", "y")]


def test_pairs_that_are_named_are_compared_as_one_family(tmp_path: Path) -> None:
    runs = [run(tmp_path / name, hits(0.9 - 0.2 * at, at)) for at, name in enumerate("abc")]
    first, second, third = (str(side_run.location) for side_run in runs)
    table = retention_table(runs, pairs=[(second, first), (third, second)])
    assert pairs(table) == [("b", "a"), ("c", "b")]
    alone = retention_table(runs, pairs=[(second, first)])
    alone_row, both = (difference(compared_table, "a", "color") for compared_table in (alone, table))
    assert (alone_row.p, alone_row.sr, alone_row.sr_ci) == (both.p, both.sr, both.sr_ci)
    tested = sorted(row.p for row in table.differences if row.category != "mean" and row.p is not None)
    assert len(tested) == 4
    assert both.p_holm is not None
    assert alone_row.p_holm is not None
    assert both.p_holm >= alone_row.p_holm
    assert retention_table(runs, pairs=()).differences == []
    with pytest.raises(UsageError, match="elsewhere is none of the runs"):
        retention_table(runs, pairs=[("elsewhere", first)])


def test_a_name_that_is_no_run_or_several_is_refused(tmp_path: Path) -> None:
    runs = [run(tmp_path / name, hits(0.5, at), called="pi0") for at, name in enumerate("ab")]
    with pytest.raises(UsageError, match=r"--reference 'c' is none of the runs a \(pi0 · .*\), b"):
        retention_table(runs, against="c")
    with pytest.raises(UsageError, match="--reference 'pi0' is several of the runs"):
        retention_table(runs, against="pi0")
    with pytest.raises(UsageError, match="there is no group 'z' to compare with; there are x, y"):
        retention_table({"x": runs[:1], "y": runs[1:]}, against="z")
    with pytest.raises(UsageError, match="needs a second run"):
        retention_table(runs[:1], against="a")


def test_one_run_twice_is_refused(tmp_path: Path) -> None:
    first = run(tmp_path / "one", hits(0.5, 0))
    with pytest.raises(UsageError, match="given twice"):
        retention_table([first, first])


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (
            {"suite": "other@1#ba9876543210"},
            "other suites (suite@1#0123456789ab and other@1#ba9876543210), without item hashes in both runs to "
            "pair items by",
        ),
        ({"seed": 4}, "other seeds (0 and 4)"),
        ({"right": hits(0.5, 1, {"counting": 4})}, "no category in common"),
    ],
)
def test_runs_on_other_questions_have_no_differences_and_every_form_says_why(
    tmp_path: Path, other: dict[str, Any], why: str
) -> None:
    from rich.console import Console

    changed_settings = {"right": hits(0.5, 1), "seed": 0} | other
    table = retention_table(
        [run(tmp_path / "other", **changed_settings), run(tmp_path / "one", hits(0.5, 0), seed=0)]
    )
    assert table.differences == []
    assert table.unpaired == (f"one and other are not compared: {why}.",)
    console = Console(width=200, record=True, file=StringIO())
    console.print(table.to_rich("all"))
    for text in (table.to_markdown(), table.to_latex("all").replace("\\#", "#"), console.export_text()):
        assert table.unpaired[0] in text


def test_other_words_are_other_questions(tmp_path: Path) -> None:
    first, other = run(tmp_path / "one", hits(0.5, 0)), run(tmp_path / "other", hits(0.5, 1))
    side = replace(other, episodes=other.episodes.assign(wording="side"))
    assert "other wordings (knowledge and side)" in retention_table([side, first]).unpaired[0]
    worded = replace(other, episodes=other.episodes.assign(wording="knowledge"))
    assert retention_table([worded, first]).differences


def with_content(said_run: SaidRun, changed: frozenset[str] = frozenset()) -> SaidRun:
    """The run with hashes of its items; those of `changed` show something else."""
    content = [f"{item}{'!' * (item in changed)}" for item in said_run.episodes["item_id"]]
    return replace(said_run, episodes=said_run.episodes.assign(item_content_sha256=content))


def test_items_that_only_one_run_has_are_left_out_and_counted(tmp_path: Path) -> None:
    first = run(tmp_path / "one", hits(0.8, 0))
    other = run(tmp_path / "other", hits(0.5, 1, {"color": 20, "shape": 10}))
    table = retention_table([other, first])
    assert [row.category for row in table.differences] == ["color", "shape", "mean"]
    shape = difference(table, "other", "shape")
    assert (shape.paired, shape.n_items, shape.of_items) == (True, 10, 24)
    theirs = other.episodes[other.episodes["category"] == "shape"].set_index("episode_id")
    mine = first.episodes.set_index("episode_id").loc[theirs.index]
    gains = (mine["outcome"] == "correct").astype(float) - (theirs["outcome"] == "correct")
    value, _, _, p = oracle(gains, theirs["group_id"])
    assert (shape.sr, shape.p) == (pytest.approx(value), pytest.approx(p))
    assert shape.sr_ci == pytest.approx(mover(mine.reset_index(), theirs.reset_index()))
    mean = difference(table, "other", "mean")
    assert (mean.n_items, mean.of_items) == (30, 44)
    assert mean.sr == pytest.approx((value + (difference(table, "other", "color").sr or 0)) / 2)
    (sentence,) = table.unpaired
    assert sentence.startswith(
        "one and other are compared on the items in common: 10 of 24 in shape. Probes are not"
    )
    assert "one − other (10 of 24 items)" in table.to_markdown()


def test_a_category_without_an_item_in_common_alone_is_left_out(tmp_path: Path) -> None:
    first, other = (with_content(run(tmp_path / name, hits(0.5, at))) for at, name in enumerate(("one", "other")))
    new = with_content(other, frozenset(other.episodes.loc[other.episodes["category"] == "shape", "item_id"]))
    table = retention_table([new, first])
    assert [row.category for row in table.differences] == ["color", "mean"]
    assert table.differences[1].categories == ("color",)
    assert table.unpaired == ("one and other are not compared in shape: no item in common.",)


def test_selections_of_one_suite_are_pairs_by_what_their_items_hold(tmp_path: Path) -> None:
    right, left_hits = hits(0.8, 0), hits(0.5, 1)
    full, part = (
        with_content(run(tmp_path / "whole", right)),
        with_content(run(tmp_path / "part", {"color": left_hits["color"]}, suite="suite@1#ba9876543210")),
    )
    partial_table = retention_table([part, full])
    same = retention_table([with_content(run(tmp_path / "same", {"color": left_hits["color"]})), full])
    both = [difference(table, name, "color") for table, name in ((partial_table, "part"), (same, "same"))]
    assert both[0].paired
    assert replace(both[0], minus="", minus_run="") == replace(both[1], minus="", minus_run="")
    changed = with_content(part, frozenset({"color-0", "color-1"}))
    fewer = difference(retention_table([changed, full]), "part", "color")
    assert (fewer.n_items, fewer.of_items) == (18, 22)  # two items of one id are two items


def test_probes_on_the_same_items_of_another_selection_are_pairs(probed_run: ProbedRun) -> None:
    def hashed(array_run: ArrayRun) -> ArrayRun:
        return replace(
            array_run, episodes=array_run.episodes.assign(item_content_sha256=array_run.episodes["item_id"])
        )

    first = hashed(probed_run({"color": SIGNAL}, "one"))
    same, part = (
        hashed(probed_run({"color": SIGNAL}, name, suite=suite))
        for name, suite in (("same", first.suite), ("part", "suite@1#ba9876543210"))
    )
    apart = replace(part, episodes=part.episodes.drop(columns="item_content_sha256"))
    tables = [retention_table([other, first]) for other in (same, part)]
    differences = [difference(table, name, "color") for table, name in zip(tables, ("same", "part"), strict=True)]
    widths = [(row.backbone_ci or (0, 0))[1] - (row.backbone_ci or (0, 0))[0] for row in differences]  # type: ignore[operator]
    assert widths[1] == pytest.approx(widths[0], rel=0.05)
    rows = tables[1].rows
    assert differences[1].backbone == pytest.approx(rows[1].backbone.score - rows[0].backbone.score)  # type: ignore[operator]
    assert retention_table([apart, first]).differences == []


def test_probes_are_not_compared_where_items_differ(probed_run: ProbedRun) -> None:
    first, other = probed_run({"color": SIGNAL}, "one"), probed_run({"color": WEAK}, "other")
    fewer = replace(other, episodes=other.episodes.iloc[:160], features={})
    save_results(load_results(other), fewer.path)
    row = difference(retention_table([fewer, first], keys=[load_results(other).key, None]), "other", "color")
    assert (row.n_items, row.of_items, row.backbone, row.retention) == (80, 100, None, None)


def test_groups_are_pairs_on_the_items_that_most_of_their_runs_have(tmp_path: Path) -> None:
    full = {"color": 20, "shape": 24}
    runs = [run(tmp_path / name, hits(0.7, at, full)) for at, name in enumerate("abc")]
    nearly = run(tmp_path / "d", hits(0.5, 4, {"color": 18, "shape": 4}))
    table = retention_table({"y": [runs[2], nearly], "x": runs[:2]})
    color, shape = (difference(table, "y", name) for name in ("color", "shape"))
    assert (color.paired, color.n_items, color.of_items) == (True, 18, 20)
    assert (shape.paired, shape.n_items) == (False, None)  # 4 of 24 are too few to give up the others
    assert table.unpaired[0].startswith("x and y are compared on the items in common: 18 of 20 in color.")


@pytest.mark.slow
def test_asked_runs_are_compared_with_asked_ones_and_acting_with_acting(tmp_path: Path) -> None:
    vlms = [answer_run(tmp_path / str(at), hits(0.7, at), f"vlm-{at}") for at in range(2)]
    policies = [run(tmp_path / f"policy-{at}", hits(0.5, at)) for at in range(2)]
    mixed = [policies[0], vlms[0], policies[1], vlms[1]]
    table = retention_table(mixed)
    assert pairs(table) == [("vlm-1", "vlm-0"), ("policy-1", "policy-0")]
    assert table.unpaired == (
        "VLM runs and policy runs are not compared with each other; `probe-kit compare --kind vlm-vla` does that.",
    )
    assert retention_table(mixed, vlm_vla=True).unpaired == ()
    assert [row.mode for row in table.differences] == ["answers"] * 3 + ["acts"] * 3
    (header, _, *lines) = table.to_markdown().split("\n\n")[1].splitlines()
    columns = [cell.strip() for cell in header.split("|")]
    cells = {line.split("|")[2].strip(): line.split("|") for line in lines if line.startswith("| Mean")}
    answered, acted = (cells[f"{name}-1 − {name}-0"] for name in ("vlm", "policy"))
    assert "[" in answered[columns.index("VLM %")]
    assert "[" not in answered[columns.index("success %")]
    assert "[" in acted[columns.index("success %")]
    assert "[" not in acted[columns.index("VLM %")]
    accuracy = [(r.episodes["outcome"] == "correct").mean() for r in vlms]
    gain = next(row.sr for row in table.differences if row.category == "mean")
    right = [row.success.sr for row in table.means if row.run.mode == "answers"]
    assert gain == pytest.approx(right[1] - right[0])  # type: ignore[operator]
    assert accuracy[0] != accuracy[1]


def test_a_run_without_probes_is_compared_in_what_it_did(probed_run: ProbedRun, tmp_path: Path) -> None:
    probed = probed_run({"color": SIGNAL})
    bare = ArrayRun(tmp_path / "bare", "bare", probed.suite, probed.episodes, {})
    table = retention_table([probed, bare])
    assert [(row.category, row.view) for row in table.differences] == [("color", None), ("mean", None)]
    assert all(row.sr == 0 and row.backbone is None for row in table.differences)


# -- names ---------------------------------------------------------------------------------------------------


def test_no_two_runs_have_one_name(tmp_path: Path) -> None:
    right = hits(0.5, 0)
    same = [run(tmp_path / part / "run", right, called="pi0") for part in "abc"]
    random = replace(run(tmp_path / "d", right, called="pi0"), random_weights=True)
    disguised = run(tmp_path / "e", right, called="pi0 (random weights)")
    runs = [*same, random, disguised]
    labels = distinct_labels(runs)
    assert len({TableRun.of(run, label=labels[str(run.location)]).name for run in runs}) == 5
    models = {row.run.label for row in retention_table(same).rows}
    assert len(models) == 3


# -- JSON ----------------------------------------------------------------------------------------------------


def test_json_of_plain_runs_is_a_list_whose_rows_hold_their_differences(tmp_path: Path) -> None:
    first, other = run(tmp_path / "one", hits(0.5, 0)), run(tmp_path / "other", hits(0.5, 1))
    alone = json.loads(retention_table([first]).to_json())
    assert all("differences" not in row for row in alone)
    both = json.loads(retention_table([first, other]).to_json())
    assert [row["run"]["location"] for row in both] == [str(tmp_path / "one")] * 3 + [str(tmp_path / "other")] * 3
    assert [{name: row[name] for name in alone[0]} for row in both[:3]] == alone
    (stored_difference,) = both[3]["differences"]
    assert stored_difference["minus_run"] == str(tmp_path / "one")
    assert stored_difference["category"] == both[3]["category"] == "color"
    assert stored_difference["sr"] == pytest.approx(both[3]["success"]["sr"] - both[0]["success"]["sr"])
    assert [row["differences"] for row in both[:3]] == [[], [], []]


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
    other, weaker, base, _ = table.rows
    assert color.backbone == pytest.approx(0.9 - 0.8, abs=1e-3)
    assert color.action == pytest.approx(base.action.score - other.action.score)  # type: ignore[operator]
    assert color.retention == pytest.approx(base.retention.value - other.retention.value)  # type: ignore[operator]
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
    first = probed_run({"color": SIGNAL}, "one")
    other = probed_run({"color": SIGNAL}, "other", suite="other@1#ba9876543210")
    row = retention_table({"a": [first], "b": [other]}).differences[0]
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
    retentions = {row.run.model: row.retention.value for row in table.rows}
    values = [[float(retentions[f"{name}{at}"] or 0) for at in range(3)] for name in groups]
    for row in (color, mean):
        over_models = row.retention_models
        assert over_models is not None
        assert (over_models.n, over_models.n_minus) == (3, 3)
        assert over_models.p == pytest.approx(0.1), "the most extreme of 20 ways, either way round"
        assert over_models.smallest_p == pytest.approx(0.1)
        assert over_models.difference == pytest.approx(np.mean(values[1]) - np.mean(values[0]))
        welch = stats.ttest_ind(*values[::-1], equal_var=False).confidence_interval()
        assert over_models.ci == pytest.approx((welch.low, welch.high))
    assert color.sr_models is not None
    assert (color.sr_models.p, color.sr_models.difference) == (1, 0), "all did the same"


def test_a_single_model_against_another_has_no_p_over_models(table: RetentionTable) -> None:
    assert all(row.sr_models is None and row.retention_models is None for row in table.differences)


def test_a_group_with_a_model_without_probes_has_no_p_of_retention(probed_run: ProbedRun, tmp_path: Path) -> None:
    first, other = (probed_run({"color": SIGNAL}, name) for name in ("one", "other"))
    bare = ArrayRun(tmp_path / "bare", "bare", first.suite, first.episodes, {})
    rows = retention_table({"b": [bare], "a": [first, other]}).differences
    assert all(row.retention is None and row.retention_models is None for row in rows)
    assert all(row.sr_models is not None and row.sr_models.n_minus == 1 for row in rows)


@pytest.fixture
def table_model_groups(probed_run: ProbedRun) -> RetentionTable:
    """Three models against three whose backbones are as good; their probes differ by chance alone."""
    names = ("one", "two", "three", "four", "five", "six")
    good = {name: ([0.5, 0.8 + 0.02 * at], [[0.6, 0.7 - 0.02 * at]]) for at, name in enumerate(names)}
    runs = [probed_run({"color": curves, "shape": curves}, name) for name, curves in good.items()]
    return retention_table({"first": runs[:3], "second": runs[3:]})


@pytest.mark.slow
def test_three_models_against_three_cannot_be_below_one_tenth(table_model_groups: RetentionTable) -> None:
    assert len(table_model_groups.differences) == 3
    for row in table_model_groups.differences:
        for test in (row.sr_models, row.retention_models):
            assert test is not None
            assert (test.n, test.n_minus, test.smallest_p) == (3, 3, pytest.approx(0.1))
            assert test.p >= test.smallest_p - 1e-12


@pytest.mark.slow
def test_every_format_shows_the_p_over_models_and_the_least_possible_one(
    table_model_groups: RetentionTable,
) -> None:
    console = Console(width=400, file=StringIO())
    console.print(table_model_groups.to_rich("all"))
    for text in (
        console.file.getvalue(),
        table_model_groups.to_markdown(),
        table_model_groups.to_latex("all"),
        table_model_groups._repr_html_(),
    ):  # type: ignore[attr-defined]
        assert "over models" in text
        assert "(0.100)" in text


@pytest.mark.slow
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


def test_a_checkpoint_and_what_grew_from_it_are_one_model_as_their_lineage_says(probed_run: ProbedRun) -> None:
    runs = sisters(probed_run)
    names = ("openvla/openvla-7b@abc", "gen-robot/openvla-7b-rlvla-sft_16k", "gen-robot/openvla-7b-rlvla-rl@def")
    other_names = ("me/openvla-7b-of-my-own", "", "lerobot/pi0")
    for run, checkpoint in zip(runs, (*names, *other_names), strict=True):
        object.__setattr__(run, "certificate", {"policy": {"family": "openvla", "checkpoint": checkpoint}})
    assert list(origins_of(runs).values()) == ["openvla/openvla-7b"] * 3 + ["d", "e", "f"]
    assert list(origins_of(runs[1:3]).values()) == ["openvla/openvla-7b"] * 2
    assert list(origins_of(runs[:1]).values()) == ["a"], "nothing that grew from it is compared"
    assert origins_of(runs[:2], {str(runs[1].location): "own"}) == {
        str(runs[0].location): "openvla/openvla-7b",
        str(runs[1].location): "own",
    }


@pytest.mark.slow
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
    assert models_test(test, with_sign).text.startswith("– ")
    alike = ModelTest.of(many, [0.53, 0.5, 0.52, 0.51, 0.49, 0.5])
    assert alike is not None
    assert alike.p is not None
    unlike = ModelTest.of(many, [*few[:2], 0.5, 0.55, 0.45, 0.5])
    assert unlike is not None
    assert unlike.p is None, "equal groups whose spreads differ by an F test do not exchange"


def test_single_runs_have_no_p_over_models(probed_run: ProbedRun) -> None:
    runs = [probed_run({"color": ([0.5, 0.9], [[0.6, 0.7]])}, name) for name in ("one", "two")]
    table_model_groups = retention_table(runs)
    assert [row.sr_models for row in table_model_groups.differences] == [None, None]
    assert "over models" not in table_model_groups.to_markdown()


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
    assert models_test(test, points).text.endswith(f" {written}")
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
