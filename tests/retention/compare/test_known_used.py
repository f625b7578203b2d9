"""The join of known, encoded and used, recomputed from first principles, and what it refuses."""

import json
import math
from collections import Counter
from dataclasses import replace
from io import StringIO
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import OtherFramesError, UsageError
from probe_kit.extract import AskSettings, ExtractSettings, ask_run, extract_run
from probe_kit.extract.prompts import TEMPLATES
from probe_kit.retention import retention_table
from probe_kit.retention.behaviour import scored
from probe_kit.retention.columns.tables import known_used_tables
from probe_kit.retention.compare.known_used import CategoryCounts, encoded_decisions, join_runs, match_runs
from probe_kit.retention.displays import KnownUsedDisplay, collect_figures
from probe_kit.retention.report import report_html
from probe_kit.runs import Run
from probe_kit.suite import Suite
from tests.retention.asked_runs import SaidRun, acted, answer_run, probes

SIZES = {"color": 14, "shape": 12}


def by_chance(seed: int, share: float) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(seed)
    return {category: draw.random((count, 2)) < share for category, count in SIZES.items()}


@pytest.fixture
def runs(tmp_path: Path) -> tuple[SaidRun, SaidRun]:
    return answer_run(tmp_path, by_chance(1, 0.9)), acted(tmp_path, by_chance(2, 0.6))


# -- the same, by loops ----------------------------------------------------------------------------------


def recount(vlm: SaidRun, policy: SaidRun, encoded: dict[str, bool], category: str) -> dict:
    """Every number of a row of the join by counting, without any of the package's functions."""
    answers = dict(zip(vlm.episodes["episode_id"], vlm.episodes["outcome"], strict=True))
    items: dict[str, list[tuple[bool, bool, bool]]] = {}
    group: dict[str, str] = {}
    for row in policy.episodes.to_dict("records"):
        if category in (row["category"], "all"):
            marks = (
                answers[row["episode_id"]] == "correct",
                encoded[row["episode_id"]],
                row["outcome"] == "correct",
            )
            items.setdefault(row["item_id"], []).append(marks)
            group[row["item_id"]] = row["group_id"]
    both = {item: tuple(all(mark[k] for mark in marks) for k in range(3)) for item, marks in items.items()}
    tests = {}
    for first, second in ((0, 2), (1, 2), (0, 1)):
        gain = {item: int(marks[first]) - int(marks[second]) for item, marks in both.items()}
        tests[first, second] = (gain, {item: group[item] for item in gain})
    return {
        "counts": Counter("".join(str(int(mark)) for mark in marks) for marks in both.values()),
        "episodes": Counter(
            "".join(str(int(m)) for m in marks) for layouts in items.values() for marks in layouts
        ),
        "tests": {pair: (binomial(gain), flips(gain, groups)) for pair, (gain, groups) in tests.items()},
        "kept": [marks[2] for marks in both.values() if marks[0] and marks[1]],
        "linked": hypergeometric([(marks[0], marks[2]) for marks in both.values() if marks[1]]),
    }


def binomial(gain: dict[str, int]) -> float:
    more, fewer = sum(g > 0 for g in gain.values()), sum(g < 0 for g in gain.values())
    n = more + fewer
    tail = sum(math.comb(n, k) for k in range(min(more, fewer) + 1)) / 2**n
    return min(1.0, 2 * tail) if n else 1.0


def flips(gain: dict[str, int], groups: dict[str, str]) -> float:
    sums = Counter()
    for item, value in gain.items():
        sums[groups[item]] += value
    values = [value for value in sums.values() if value]
    total = abs(sum(values))
    flipped_sums = [
        abs(sum(s * v for s, v in zip(signs, values, strict=True)))
        for signs in product((1, -1), repeat=len(values))
    ]
    return sum(flipped >= total for flipped in flipped_sums) / len(flipped_sums)


def hypergeometric(marks: list[tuple[bool, bool]]) -> float:
    """Fisher's two-sided p: all tables of these margins that are no likelier."""
    n, known_count, used = len(marks), sum(k for k, _ in marks), sum(u for _, u in marks)
    chance = {
        x: math.comb(known_count, x) * math.comb(n - known_count, used - x) / math.comb(n, used)
        for x in range(max(0, used - (n - known_count)), min(known_count, used) + 1)
    }
    observed = chance[sum(k and u for k, u in marks)]
    return sum(p for p in chance.values() if p <= observed * (1 + 1e-7))


def interval(hits: int, n: int) -> tuple[float, float]:
    """Clopper and Pearson's, by halving."""

    def below(k: int, share: float) -> float:
        return sum(math.comb(n, x) * share**x * (1 - share) ** (n - x) for x in range(k + 1))

    def solve(right: float, k: int) -> float:
        low, high = 0.0, 1.0
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if below(k, middle) > right else (low, middle)
        return low

    return (0.0 if hits == 0 else solve(0.975, hits - 1)), (1.0 if hits == n else solve(0.025, hits))


def test_the_join_is_what_an_independent_count_gives(runs: tuple[SaidRun, SaidRun]) -> None:
    vlm, policy = runs
    results = probes(policy, {"color": [0.5, 0.8, 0.85], "shape": [0.7, 0.9]})
    encoded: dict[str, bool] = {}
    for curve in results.curves.values():
        encoded |= dict(zip(curve.episodes, encoded_decisions(curve), strict=True))
    join = match_runs(vlm, policy, results)
    assert [row.category for row in join.rows] == ["color", "shape", "all"]
    for row in join.rows:
        expected = recount(vlm, policy, encoded, row.category)
        assert {code: n for code, n in row.counts.items() if n} == dict(expected["counts"])
        assert {code: n for code, n in row.episodes.items() if n} == dict(expected["episodes"])
        for comparison, (pair, (binomial_p, flip)) in zip(row.comparisons, expected["tests"].items(), strict=True):
            assert (comparison.first, comparison.second) == tuple(
                ("answered", "encoded", "acted")[k] for k in pair
            )
            assert comparison.p_mcnemar == pytest.approx(binomial_p)
            assert comparison.p_groups == pytest.approx(flip)
            assert comparison.p == max(comparison.p_mcnemar, comparison.p_groups)
        lost = expected["kept"].count(False)
        assert (row.answered_and_encoded, row.not_acted_on) == (len(expected["kept"]), lost)
        assert row.share_not_acted_on_ci == pytest.approx(interval(lost, len(expected["kept"])), abs=1e-6)
        if row.category != "all":
            assert row.p_linked == pytest.approx(expected["linked"])
    singles = [comparison.p for row in join.rows[:2] for comparison in row.comparisons]
    order = np.argsort(singles)
    stepped = np.maximum.accumulate([(6 - rank) * singles[at] for rank, at in enumerate(order)]).clip(max=1)
    holm = [comparison.p_holm for row in join.rows[:2] for comparison in row.comparisons]
    np.testing.assert_allclose(np.array(holm)[order], stepped)


def test_encoded_decisions_are_chosen_on_other_groups(tmp_path: Path) -> None:
    """Among a hundred sites that guess the best one looks good, and its held-out decisions still guess."""
    policy = acted(tmp_path, {"color": np.ones((60, 2), bool)})
    curves = [probes(policy, {"color": [0.5] * 100}, seed=seed).curves["color", "mean"] for seed in range(10)]
    luck = np.mean([curve.correct.mean(axis=1).max() for curve in curves])
    held_out = np.mean([encoded_decisions(curve).mean() for curve in curves])
    assert luck > 0.58
    assert abs(held_out - 0.5) < 0.04


def test_a_habit_is_neither_known_nor_used_and_a_coin_is_expected_in_a_quarter(tmp_path: Path) -> None:
    one_side = {"color": np.array([[True, False], [False, True]] * 10)}
    join = match_runs(answer_run(tmp_path, one_side), acted(tmp_path, one_side))
    (row,) = join.rows
    assert (row.answered_correctly, row.acted_correctly, row.encoded) == (0, 0, None)
    assert row.counts == {"1-1": 0, "1-0": 0, "0-1": 0, "0-0": 20}
    assert row.guessed == pytest.approx({"1-1": 1.25, "1-0": 3.75, "0-1": 3.75, "0-0": 11.25})
    assert row.episodes == {"1-1": 20, "1-0": 0, "0-1": 0, "0-0": 20}


def test_another_score_of_the_vlm_is_another_join(runs: tuple[SaidRun, SaidRun]) -> None:
    vlm, policy = runs
    assert match_runs(scored(vlm, "logits"), policy).rows[-1].answered_correctly == 0, "it always says left"
    balanced = match_runs(scored(vlm, "order-balanced"), policy)
    assert balanced.rows[-1].answered_correctly == 26
    assert balanced.score == "order-balanced"


def test_a_run_that_is_scored_again_is_read_by_the_last_score_alone(runs: tuple[SaidRun, SaidRun]) -> None:
    vlm, _ = runs
    again = scored(scored(vlm, "logits"), "text")
    assert again.episodes["outcome"].tolist() == scored(vlm, "text").episodes["outcome"].tolist()
    assert again.episodes["outcome"].tolist() != scored(vlm, "logits").episodes["outcome"].tolist()


def test_probes_that_beat_nothing_are_said_to_encode_nothing(runs: tuple[SaidRun, SaidRun]) -> None:
    vlm, policy = runs
    join = match_runs(vlm, policy, probes(policy, {"color": [0.95], "shape": [0.5]}, null_top=0.75))
    assert [row.has_signal for row in join.rows] == [True, False, None]
    assert any(note.startswith("In shape probes are not shown to exceed") for note in join.notes)
    color, shape, total_row = join.rows
    assert (shape.answered_and_encoded, shape.share_not_acted_on) == (None, None)
    for name in ("answered_and_encoded", "not_acted_on", "share_not_acted_on", "share_not_acted_on_ci"):
        assert getattr(total_row, name) == getattr(color, name), "shape's guesses do not count"


def test_frames_that_differ_or_have_no_hash_are_refused(runs: tuple[SaidRun, SaidRun]) -> None:
    vlm, policy = runs
    other = policy.episodes.assign(
        first_frame_sha256=policy.episodes["first_frame_sha256"].where(policy.episodes.index > 1, "another")
    )
    with pytest.raises(OtherFramesError, match="2 of 52 episodes begin with another frame"):
        match_runs(vlm, replace(policy, episodes=other))
    for bare in (policy.episodes.drop(columns="first_frame_sha256"), other.assign(first_frame_sha256=None)):
        with pytest.raises(OtherFramesError, match="does not say what its first frames were"):
            match_runs(vlm, replace(policy, episodes=bare))


def test_runs_of_the_wrong_kind_or_of_other_questions_are_refused(runs: tuple[SaidRun, SaidRun]) -> None:
    vlm, policy = runs
    with pytest.raises(UsageError, match="not a VLM run and a policy run, in this order"):
        match_runs(policy, vlm)
    strange = policy.episodes.assign(item_id="other-" + policy.episodes["item_id"])
    with pytest.raises(UsageError, match="no question in common"):
        match_runs(vlm, replace(policy, episodes=strange))
    half = policy.episodes[policy.episodes["layout"] == "original"]
    with pytest.raises(UsageError, match="no item in both layouts"):
        match_runs(vlm, replace(policy, episodes=half))
    with pytest.raises(UsageError, match="view 'last' was not probed"):
        match_runs(vlm, policy, probes(policy, {"color": [0.9], "shape": [0.9]}), "last")


def test_a_comparison_notes_the_episodes_that_it_leaves_out(runs: tuple[SaidRun, SaidRun]) -> None:
    vlm, policy = runs
    fewer = replace(vlm, episodes=vlm.episodes[vlm.episodes["category"] == "color"])
    join = match_runs(fewer, policy, probes(policy, {"color": [0.9]}))
    assert [row.category for row in join.rows] == ["color"]
    assert any(note.startswith("24 episodes of") for note in join.notes)


def test_it_reads_on_a_console_as_a_frame_and_as_plain_values(runs: tuple[SaidRun, SaidRun]) -> None:
    vlm, policy = runs
    join = match_runs(vlm, policy, probes(policy, {"color": [0.9], "shape": [0.9]}))
    console = Console(width=150, record=True, file=StringIO())
    console.print(*known_used_tables(join))
    text = console.export_text()
    titles = ("Answer, probe, success", "of these without success", "Single episodes", "answer − success")
    for words in (*titles, "V P s"):
        assert words in text
    frame = join.to_frame()
    assert frame.groupby("category")["items"].sum().to_dict() == {"color": 14, "shape": 12, "all": 26}
    assert join.to_json()["rows"][0]["counts"] == join.rows[0].counts
    assert isinstance(join.rows[0], CategoryCounts)
    assert isinstance(frame, pd.DataFrame)


KNOWN = {"color": np.array([[1, 1], [1, 1], [0, 1], [0, 0]], bool)}
USED = {"color": np.array([[1, 1], [0, 1], [1, 1], [0, 0]], bool)}


def pair(folder: Path) -> tuple[object, SaidRun]:
    return scored(answer_run(folder, KNOWN), "text"), acted(folder, USED)


def test_bars_are_the_counts_of_the_join(tmp_path: Path) -> None:
    vlm, policy = pair(tmp_path)
    joined = match_runs(vlm, policy)  # type: ignore[arg-type]
    display = KnownUsedDisplay.from_join(joined).plot()
    assert display.counts == {"color": {"1-1": 1, "1-0": 1, "0-1": 1, "0-0": 1}}
    axes = display.ax_
    assert axes is not None
    assert [patch.get_width() for patch in axes.patches] == [25.0] * 4  # type: ignore[attr-defined]
    labels = [text.get_text() for legend in axes.figure.legends for text in legend.get_texts()]  # type: ignore[union-attr]
    assert labels == [
        "answer right, success",
        "answer not, success",
        "answer right, no success",
        "answer not, no success",
    ]


@pytest.mark.slow
def test_the_report_of_an_asked_and_an_acting_run_holds_their_join(tmp_path: Path) -> None:
    vlm, policy = pair(tmp_path)
    runs = [vlm, policy]
    table = retention_table(runs)  # type: ignore[arg-type]
    (joined,) = join_runs(table.runs, table.results).tables
    assert [exhibit.name for exhibit in collect_figures(runs, table) if exhibit.subject == "join"] == [
        "known-used-1"
    ]  # type: ignore[arg-type]
    page = report_html(runs, table).replace("\u00a0", " ")  # type: ignore[arg-type]
    section = page.split('<details class="part" id="join">')[1].split("</details>")[0]
    for plain in known_used_tables(joined):
        assert plain.title in section
        for cells in plain.texts:
            assert all(f">{cell}<" in section for cell in cells if "[" not in cell)
    assert section.count("<img") == 1


@pytest.mark.slow
def test_runs_that_saw_other_frames_are_not_joined_and_the_report_says_so(tmp_path: Path) -> None:
    vlm, policy = pair(tmp_path)
    policy.episodes["first_frame_sha256"] = "other"
    runs = [vlm, policy]
    table = retention_table(runs)  # type: ignore[arg-type]
    joins = join_runs(table.runs, table.results)
    assert joins.tables == ()
    assert "begin with another frame" in joins.refused[0]
    assert "begin with another frame" in report_html(runs, table)  # type: ignore[arg-type]


def test_acting_runs_alone_have_no_join(tmp_path: Path) -> None:
    _, policy = pair(tmp_path)
    assert 'id="join"' not in report_html([policy])


# `tests/acceptance` holds what a user sees of the command, so that its own tests are slow.


@pytest.fixture(scope="module")
def runs_stages_command(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Run]:
    """An untrained VLM that was asked, and a scripted expert that acted, on the same frames."""
    folder = tmp_path_factory.mktemp("stages")
    scene = SceneSpec(max_steps=4)
    subset = {"suite": small_suite.folder, "categories": ("color",), "items": 4, "scene": scene}
    answer_run = ask_run(
        AskSettings("vlm-tiny", random_weights=True, prompt=TEMPLATES["p1"], **subset), folder / "asked"
    )
    acted = extract_run(ExtractSettings("expert", **subset), folder / "acted")
    return answer_run, acted


@pytest.mark.slow
def test_it_prints_the_counts_of_match_runs_and_draws_their_figure(
    runs_stages_command: tuple[Run, Run], tmp_path: Path
) -> None:
    answer_run, acted = runs_stages_command
    command = ["compare", str(answer_run.path), str(acted.path), "--kind", "stages"]
    answer = CliRunner().invoke(app, [*command, "--format", "json"])
    assert answer.exit_code == 0, answer.output
    assert json.loads(answer.stdout) == json.loads(
        json.dumps(match_runs(scored(answer_run, "text", False), acted).to_json())
    )
    drawn = CliRunner().invoke(app, [*command, "--figures", str(tmp_path / "figures")])
    assert "Answer, probe, success" in drawn.stdout
    assert list((tmp_path / "figures").glob("*.png"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--format", "csv"], "--format csv is not for --kind stages"),
        (["--rule", "box"], "--rule is not for --kind stages"),
        (["--as-paper"], "--as-paper is not for --kind stages"),
        (["--views", "mean,last"], "--kind stages reads probes of one view; --views mean,last has 2. Give one"),
        (["--views", "mean"], "has no activations to probe"),
    ],
)
def test_options_of_other_tables_are_refused(
    options: list[str], words: str, runs_stages_command: tuple[Run, Run]
) -> None:
    answer = CliRunner().invoke(
        app, ["compare", *(str(run.path) for run in runs_stages_command), "--kind", "stages", *options]
    )
    assert answer.exit_code == 2
    assert words in " ".join(answer.stderr.split())


@pytest.mark.slow
def test_it_needs_two_runs(runs_stages_command: tuple[Run, Run]) -> None:
    answer = CliRunner().invoke(app, ["compare", str(runs_stages_command[0].path), "--kind", "stages"])
    assert answer.exit_code == 2
    assert "expected VLM_RUN RUN" in answer.stderr
