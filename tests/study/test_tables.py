"""Named tables from runs whose outcomes are known."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from statistics import fmean
from typing import Any

import numpy as np
import pytest
from matplotlib.patches import Rectangle
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.retention import retention_table
from probe_kit.retention.behaviour import scored
from probe_kit.retention.compare.known_used import match_runs
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.statistics.paired_tests import holm
from probe_kit.study import LoadedStudy, load_study, make_figures, make_table, write_study_report
from probe_kit.study.rates import caption, domain_scores, score_table, success_table, vlm_table
from probe_kit.study.report import draw_overview
from probe_kit.study.tables import difference_table, stages_table
from tests.retention.asked_runs import SaidRun, acted, answer_run, probes
from tests.view.payload_reader import read_payload


def test_stages_count_items_that_are_right_in_both_layouts(tmp_path: Path) -> None:
    draw = np.random.default_rng(3)
    vlm_hits, used = draw.random((20, 2)) < 0.8, draw.random((20, 2)) < 0.6
    vlm, policy = answer_run(tmp_path, {"color": vlm_hits}), acted(tmp_path, {"color": used})
    bare = stages_table([match_runs(scored(vlm, "text"), policy)])
    (row,) = bare.texts
    assert row[1:6] == ("Color", "20", str(int(vlm_hits.all(axis=1).sum())), "–", str(int(used.all(axis=1).sum())))
    with_probes = stages_table([match_runs(scored(vlm, "text"), policy, probes(policy, {"color": [0.9, 0.5]}))])
    (number,) = with_probes.numbers
    assert number["encoded"] is not None
    assert number["answered_and_encoded"] <= min(number["answered"], number["encoded"])
    (cells,) = with_probes.texts
    assert cells[6] == str(number["answered_and_encoded"])
    assert cells[7].startswith(f"{100 * number['share_not_acted_on']:.1f} [")


def test_stages_show_no_encoded_items_where_probes_have_no_signal(tmp_path: Path) -> None:
    draw = np.random.default_rng(3)
    vlm_hits, used = ({name: draw.random((20, 2)) < 0.8 for name in ("color", "shape")} for _ in range(2))
    vlm, policy = answer_run(tmp_path, vlm_hits), acted(tmp_path, used)
    probe_results = probes(policy, {"color": [0.95], "shape": [0.5]}, null_top=0.75)
    table = stages_table([match_runs(scored(vlm, "text"), policy, probe_results)])
    color, shape, total = table.texts
    assert shape[4:] == ("not shown", shape[5], "–", "–")
    assert total[4] == color[4]
    assert total[6:] == color[6:]
    assert "probes are not shown to exceed chance" in "; ".join(table.notes)
    assert [number["encoded"] for number in table.numbers][1:] == [None, int(color[4])]


RIGHT = {"emotion": 0.5, "color": 0.9, "shape": 0.7, "traffic": 0.2}


def drawn(names: list[str], items: int = 20, seed: int = 0) -> list[SaidRun]:
    """A policy run per name whose episodes are right with these shares."""
    draw = np.random.default_rng(seed)
    right = [{category: draw.random((items, 2)) < share for category, share in RIGHT.items()} for _ in names]
    return [
        replace(acted(Path("/made") / name, hits, name), path=Path("/made") / name)
        for name, hits in zip(names, right, strict=True)
    ]


def test_domains_of_several_categories_have_the_mean_of_their_category_means() -> None:
    table = retention_table(drawn(["one", "two"]), pairs=())
    printed_table = success_table(table)
    assert printed_table.columns == (
        "system", "Emotion", "Color", "Shape", "physical", "Traffic", "mean", "score",
    )  # fmt: skip
    assert [heading.group for heading in printed_table.headings] == [
        "",
        "social",
        *["physical"] * 3,
        "normative",
        "",
        "",
    ]
    rates = {row.category: row.success.sr or 0 for row in table.rows if row.run.label == "one"}
    cell_by_heading = dict(zip(printed_table.columns, printed_table.texts[0], strict=True))
    assert cell_by_heading["physical"] == f"{50 * (rates['color'] + rates['shape']):.1f}"
    assert cell_by_heading["score"] == f"{200 * (fmean(rates.values()) - 0.5):.2f}"
    (number,) = [
        record for record in printed_table.numbers if record["system"] == "one" and record.get("categories")
    ]
    assert (number["domain"], number["sr"]) == ("physical", pytest.approx((rates["color"] + rates["shape"]) / 2))
    assert "outcome rule disc; 40 episodes per category" in "; ".join(printed_table.notes)


def test_a_caption_says_rule_call_and_episodes_of_what_is_in_the_table() -> None:
    table = retention_table(drawn(["one"]), pairs=())
    assert caption(table, ["first", "second"]) == "first; second; outcome rule disc; 40 episodes per category"

    def changed(row: RetentionRow, call: int | None = None, **success: Any) -> RetentionRow:
        return replace(row, run=replace(row.run, call=call), success=replace(row.success, **success))

    first, *other_rows = table.rows
    of_calls = replace(table, rows=(changed(first, 2), *(changed(row, 0) for row in other_rows)))
    assert caption(of_calls, []) == "outcome rule disc; captured inference 0, 2; 40 episodes per category"
    at_first = replace(table, rows=tuple(changed(row, 0) for row in table.rows))
    assert caption(at_first, []) == "outcome rule disc; 40 episodes per category"
    uneven = replace(table, rows=(changed(first, n_episodes=12), *other_rows))
    assert caption(uneven, []) == "outcome rule disc; 12 to 40 episodes per category"
    never_acted = replace(table, rows=tuple(changed(row, sr=None) for row in table.rows))
    assert caption(never_acted, []) == "40 episodes per category"
    assert caption(replace(table, rows=()), ["alone"]) == "alone"


def test_latex_spans_domains() -> None:
    text = success_table(retention_table(drawn(["one"]), pairs=())).to_latex()
    assert r" & social & \multicolumn{3}{c}{physical} & " in text
    assert "↑" not in text
    assert r"$\uparrow$" in text


def test_fewer_than_ten_groups_have_no_p_and_no_part_in_holms_correction() -> None:
    """Twenty items are ten groups in a category; eighteen are nine."""
    first, two = drawn(["one", "two"])
    nine = two.episodes[~((two.episodes["category"] == "color") & two.episodes["group_id"].str.endswith("-9"))]
    differences = difference_table(retention_table([first, replace(two, episodes=nine)]), "compared")
    p = {number["category"]: number["p"] for number in differences.numbers}
    assert p["color"] is None
    assert None not in (p["emotion"], p["shape"], p["traffic"], p["mean"])
    p_values = [(number["p"], number["p_holm"]) for number in differences.numbers if number["category"] in RIGHT]
    assert holm([raw_p for raw_p, _ in p_values]) == [corrected for _, corrected in p_values]
    assert "no p with fewer than 10 independent groups of items" in "; ".join(differences.notes)
    assert dict(zip(p, (cells[4] for cells in differences.texts), strict=True))["color"] == "18 of 20"
    assert sum(value is not None for value in p.values()) == 4


def test_less_than_four_fifths_of_the_items_in_common_is_marked() -> None:
    first, two = drawn(["one", "two"], items=30)
    is_common = two.episodes["group_id"].str.rsplit("-", n=1).str[-1].astype(int) < 11
    differences = difference_table(
        retention_table([first, replace(two, episodes=two.episodes[is_common])]), "compared"
    )
    assert {cells[4] for cells in differences.texts} == {"22 of 30 !", "88 of 120 !"}
    assert "! fewer than 80 % of the items in common" in "; ".join(differences.notes)


def test_numbers_from_elsewhere_stand_beside_the_score_with_their_source() -> None:
    first, two = drawn(["one", "two"])
    table = retention_table([first, two], pairs=())
    scores = score_table(table, "LIBERO %", "a paper", {str(first.location): 76.5})
    assert scores.columns[-1] == "LIBERO %"
    assert [cells[-1] for cells in scores.texts] == ["76.5", "–"]
    assert "LIBERO %: not measured here, from a paper" in "; ".join(scores.notes)
    (mean, _) = table.means
    assert mean.success.ci is not None
    limits = [(end or 0) * 200 - 100 for end in mean.success.ci]
    assert scores.numbers[0]["score_ci"] == pytest.approx(limits)


def test_vlms_are_listed_by_prompt_and_size_of_the_picture(tmp_path: Path) -> None:
    right = {"color": np.ones((20, 2), bool)}
    run = answer_run(tmp_path, right, prompt="p2", picture_size="560x480")
    table = vlm_table(retention_table([run], pairs=()))
    assert table.columns == ("system", "prompt", "picture", "Color", "mean")
    assert table.texts[0][1:3] == ("p2", "560x480")


def test_a_rate_whose_interval_and_range_of_guessing_disagree_is_marked() -> None:
    """Items of a group that answer alike widen the one and the other by different rules."""
    table = retention_table(drawn(["one"]), pairs=())
    rows = [replace(row, success=replace(row.success, ci=(0.51, 0.9))) for row in table.rows]
    printed_table = success_table(replace(table, rows=rows))
    cell_by_heading = dict(zip(printed_table.columns, printed_table.texts[0], strict=True))
    assert cell_by_heading["Emotion"].endswith(" *")
    assert not cell_by_heading["Color"].endswith("*")
    assert "disagree about 50 %" in "; ".join(printed_table.notes)


@pytest.mark.slow
def test_without_a_name_all_tables_are_printed_and_their_tests_are_counted(
    played: LoadedStudy, tmp_path: Path
) -> None:
    run = CliRunner()
    result = run.invoke(app, ["study", "table", str(played.file)])
    assert result.exit_code == 0, result.output
    for title in ("Success rate %", "Success rate % by side and layout", "Normalised score", "light"):
        assert title in result.stdout
    assert "4 tables with 0 tests" in result.stderr, "two items are too few for any"
    answer = json.loads(run.invoke(app, ["study", "table", str(played.file), "--format", "json"]).stdout)
    assert list(answer) == ["main", "sides", "score", "light"]
    file = tmp_path / "drift.toml"
    drift = '[drift.one]\npairs = [["expert", "idle"]]\n[tables.drift]\nkind = "drift"\ndrift = "one"\n'
    file.write_text(f"{played.file.read_text(encoding='utf-8')}{drift}", encoding="utf-8")
    partly = run.invoke(app, ["study", "table", str(file), "--partial"])
    assert partly.exit_code == 1
    assert "no table drift: " in partly.stderr
    assert "4 tables" in partly.stderr
    assert run.invoke(app, ["study", "table", str(file)]).exit_code != 0


@pytest.mark.slow
def test_a_table_is_also_rows_of_csv_with_both_ends_of_intervals(played: LoadedStudy) -> None:
    run = CliRunner()
    numbers = make_table(played, "score").numbers
    printed = run.invoke(app, ["study", "table", str(played.file), "score", "--format", "csv"])
    rows = list(csv.DictReader(io.StringIO(printed.stdout, newline="")))
    assert [row["system"] for row in rows] == [number["system"] for number in numbers]
    assert [float(row["score"]) for row in rows] == [number["score"] for number in numbers]
    assert [(row["score_ci_low"], row["score_ci_high"]) for row in rows] == [
        ("", "") if number["score_ci"] is None else tuple(map(str, number["score_ci"])) for number in numbers
    ]
    assert "score_ci" not in rows[0]
    every = run.invoke(app, ["study", "table", str(played.file), "--format", "csv"])
    assert every.exit_code == 2
    assert "one table" in every.stderr
    assert "main, sides, score, light" in every.stderr


@pytest.mark.slow
def test_a_report_is_one_page_with_state_tables_figures_and_the_file(played: LoadedStudy, tmp_path: Path) -> None:
    file, page, run = tmp_path / "named.toml", tmp_path / "report.html", CliRunner()
    text = played.file.read_text(encoding="utf-8").partition("[figures.dose]")[0]
    text = text.replace('label = "Idle"', 'label = "<b>Idle & 5 %</b>"')
    file.write_text(text, encoding="utf-8")
    before = file_times(Path(played.study.folder))
    result = run.invoke(app, ["study", "table", str(file), "--html", str(page)])
    assert result.exit_code == 0, result.output
    html = page.read_text(encoding="utf-8")
    made_of = (
        "table-main",
        "table-sides",
        "table-score",
        "table-light",
        "figure-overview",
        "file",
    )
    assert all(f'id="{name}"' in html for name in made_of)
    assert html.count('<img class="plot"') == 1
    assert "&lt;b&gt;Idle &amp; 5\u00a0%&lt;/b&gt;" in html
    assert "<b>Idle" not in html
    assert str(tmp_path.parent) not in html
    assert 'src="http' not in html
    assert write_study_report(load_study(file), page).html == html
    assert file_times(Path(played.study.folder)) == before
    file.write_text(text.replace("light_level = 0.7", "light_level = 0.6"), encoding="utf-8")
    both = run.invoke(app, ["study", "table", str(file), "main", "--html", str(page)])
    assert both.exit_code == 2
    assert "leave NAME and --format out" in both.stderr
    refused = run.invoke(app, ["study", "table", str(file), "--html", str(tmp_path / "other.html")])
    assert refused.exit_code == 1
    assert not (tmp_path / "other.html").exists()
    partly = run.invoke(app, ["study", "table", str(file), "--html", str(page), "--partial"])
    assert partly.exit_code == 1
    assert "· dark is missing: not played yet" in page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_dry_run_finds_changed_bytes_and_runs_that_the_file_does_not_use(
    played: LoadedStudy, tmp_path: Path
) -> None:
    out, file, run = copytree(played.study.folder, tmp_path / "out"), tmp_path / "study.toml", CliRunner()
    text = played.file.read_text(encoding="utf-8").replace(played.study.folder, str(out))
    file.write_text(text, encoding="utf-8")
    words = ["study", "run", str(file), "--dry-run", "--exit-code", "--json", "--verify", "--orphans"]
    intact = run.invoke(app, words)
    assert intact.exit_code == 0, intact.output
    answer = json.loads(intact.stdout)
    assert (answer["problems"], answer["orphans"]) == ({}, [])
    (commit, *_) = sorted(out.glob("expert/*/data.zarr/trajectory/c/1/*/*"))
    commit.write_bytes(commit.read_bytes()[:-1] + b"?")
    assert run.invoke(app, words[:-2]).exit_code == 0, "what is not read is not compared"
    file.write_text(text.replace("light_level = 0.7", "light_level = 0.6"), encoding="utf-8")
    changed = run.invoke(app, words)
    assert changed.exit_code == 1
    answer = json.loads(changed.stdout)
    assert list(answer["problems"]) == ["expert/short"]
    assert "has other bytes than were written" in answer["problems"]["expert/short"][0]
    assert [Path(orphan).name.partition("-")[0] for orphan in answer["orphans"]] == ["dark"]


def file_times(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def test_the_viewer_opens_every_stored_run_of_a_study(played: LoadedStudy, tmp_path: Path) -> None:
    answer = CliRunner().invoke(
        app, ["view", str(played.file), "--export", str(tmp_path / "page"), "--without-frames"]
    )
    assert answer.exit_code == 0, answer.output
    data = Path(answer.stdout.strip()).parent / "data"
    _, index = read_payload((data / "index.js").read_bytes())
    cells = [Path(cell.folder).name for cell in played.cells]
    assert [record["key"] for record in index["runs"]] == cells
    assert [record["episodes"] for record in index["runs"]] == [cell.episodes for cell in played.cells]
    for cell, key in zip(played.cells, cells, strict=True):
        assert read_payload((data / key / "run.js").read_bytes())[1]["model"] == cell.settings.model.family


def test_the_overview_has_a_panel_per_domain_and_a_bar_per_system_on_one_scale(tmp_path: Path) -> None:
    right = {
        "color": np.ones((20, 2), bool),
        "shape": np.tile([True, False], (20, 1)),
        "traffic": np.zeros((20, 2), bool),
    }
    table = retention_table(
        [acted(tmp_path / "one", right, "one"), acted(tmp_path / "two", right, "two")], pairs=()
    )
    assert domain_scores(table) == {
        "physical": {"one": 50.0, "two": 50.0},
        "normative": {"one": -100.0, "two": -100.0},
    }
    figure = draw_overview(table)
    visible = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title(loc="left") for axes in visible] == ["physical", "normative"]
    assert {axes.get_xlim() for axes in visible} == {(-105.0, 105.0)}
    bars = [[p.get_width() for p in axes.patches if isinstance(p, Rectangle)] for axes in visible]
    assert bars == [[50.0, 50.0], [-100.0, -100.0]]


def test_the_overview_says_what_has_no_episodes_and_takes_names_as_they_are(tmp_path: Path) -> None:
    right, name = np.ones((20, 2), bool), r"a $\frac{1$ b $5^^$"
    both = acted(tmp_path / "both", {"color": right, "traffic": right}, name)
    table = retention_table([both, acted(tmp_path / "one", {"color": right}, "one")], pairs=())
    figure = draw_overview(table)
    physical, normative = (axes for axes in figure.axes if axes.get_visible())
    assert [[text.get_text() for text in axes.texts] for axes in (physical, normative)] == [[], ["no episodes"]]
    figure.savefig(tmp_path / "overview.svg")
    assert name in [text.get_text() for text in physical.get_yticklabels()]


@pytest.mark.slow
def test_figures_are_drawn_by_name_from_stored_runs(played: LoadedStudy, tmp_path: Path) -> None:
    out = tmp_path / "figures"
    result = CliRunner().invoke(app, ["study", "figure", str(played.file), "overview", "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in out.iterdir()) == ["overview.pdf", "overview.png"]
    assert result.stdout.strip() == str(out / "overview.png")


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("dose", "was steered. Steer one with `probe-kit intervene"),
        ("overveiw", "unknown figure 'overveiw'; known: overview, .* Did you mean 'overview'"),
    ],
)
def test_a_table_names_missing_results_with_the_command_that_makes_them(
    played: LoadedStudy, name: str, reason: str
) -> None:
    with pytest.raises(UsageError, match=reason):
        make_figures(played, name)
