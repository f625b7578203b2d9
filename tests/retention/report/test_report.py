"""The report: one file, complete, with numbers that are the table's and words that fit them."""

import json
import re
import subprocess
import sys
from base64 import b64decode
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from io import BytesIO
from pathlib import Path
from typing import Any, get_args
from urllib.parse import unquote
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from probe_kit._tables.table import Table
from probe_kit.errors import UsageError
from probe_kit.intervene.settings import FORMAT
from probe_kit.intervene.verdict import Behaviour
from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.columns.columns import all_columns
from probe_kit.retention.columns.summary import HEADING_HELP
from probe_kit.retention.columns.tables import retention_tables
from probe_kit.retention.columns.text import TERMS, VERDICT_HELP, Modes, Readable, warnings_of
from probe_kit.retention.displays.report_figure import ReportFigure, collect_figures
from probe_kit.retention.report import page, report_html, write_report
from probe_kit.retention.report.episodes import BLOCK, episode_grid
from probe_kit.retention.report.page import citation, compact_svg, data_uri
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import as_thumbnail, read_thumbnail, thumbnail_key
from probe_kit.train import ArrayRun, load_results
from probe_kit.train.results.control_scores import Controls
from probe_kit.train.results.store import save_results
from tests.intervene.answers import follower, outcomes_of, store_outcomes
from tests.support.recorded_run import write_recorded_run

ProbedRun = Callable[..., ArrayRun]
SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7], [0.5, 0.65]])
NOISE = ([0.5, 0.52, 0.5], [[0.5, 0.5], [0.5, 0.51]])


def plain_run(folder: Path, episodes: pd.DataFrame, model: str = "pi0") -> ArrayRun:
    return ArrayRun(folder, model, "suite@1#0123456789ab", episodes, {})


def cards(page: str) -> list[dict[str, Any]]:
    match = re.search(r'<script type="application/json" id="cards"[^>]*>(.*?)</script>', page, re.DOTALL)
    assert match
    listed: list[dict[str, Any]] = json.loads(match[1])
    return listed


@pytest.mark.slow
def test_the_page_needs_nothing_but_itself(probed_run: ProbedRun) -> None:
    page = report_html([probed_run({"color": SIGNAL})])
    assert "<b>Bold</b>: above chance and every control" in page
    assert not re.findall(r"(?:src|href)=[\"'](?!#|data:)", page)
    assert "@import" not in page
    assert "default-src 'none'" in page


@pytest.mark.slow
def test_the_same_run_gives_the_same_page(probed_run: ProbedRun) -> None:
    run = probed_run({"color": SIGNAL, "shape": NOISE})
    assert report_html([run]) == report_html([run])


@pytest.mark.slow
def test_every_link_of_the_contents_leads_somewhere(probed_run: ProbedRun) -> None:
    page = report_html([probed_run({"color": SIGNAL})])
    links = re.findall(r'href="#([\w-]+)"', page)
    assert {"summary", "behaviour", "knowledge", "retention", "episodes", "settings", "words", "cite"} <= set(
        links
    )
    assert all(f'id="{link}"' in page for link in links)


@pytest.mark.slow
def test_the_page_opens_with_what_is_encoded_and_used_in_plain_words(probed_run: ProbedRun) -> None:
    page = report_html([probed_run({"color": SIGNAL, "shape": NOISE}, "pi0-tiny")])
    opening = page[page.index('<section id="summary"') : page.index('<details class="part"')]
    assert "Summary: pi0-tiny" in opening
    color, shape = re.findall(r"<li>(.*?)</li>", opening.replace("\u00a0", " "), re.DOTALL)
    assert "<b>Color</b> encoded, use not tested: probes read the answer in the backbone and the action" in color
    assert "<b>Shape</b> absent: probes of 100 items do not find the answer in the backbone" in shape


def test_random_weights_are_marked_in_summary_figures_and_certificate(probed_run: ProbedRun) -> None:
    page = report_html([probed_run({"color": NOISE}, "pi0-tiny", random_weights=True)])
    assert "RANDOM WEIGHTS" in page
    assert "the model is untrained" in page


def test_names_and_instructions_cannot_become_markup(tmp_path: Path, outcome_table: Any) -> None:
    hostile = "</script><img src=x onerror=alert(1)>"
    page = report_html([plain_run(tmp_path, outcome_table(6, 4, 2).assign(instruction=hostile), hostile)])
    assert "<img src=x" not in page
    assert cards(page)[0]["instruction"] == hostile


def test_a_run_without_probes_has_a_report_of_its_behaviour(tmp_path: Path, outcome_table: Any) -> None:
    page = report_html([plain_run(tmp_path, outcome_table(6, 4, 2))])
    assert 'id="knowledge"' not in page
    assert "the cube ends right in 50\u00a0%" in page


def test_a_report_without_runs_is_an_error() -> None:
    with pytest.raises(UsageError, match="at least one run"):
        report_html([])


@pytest.mark.slow
def test_a_report_is_written_whole_and_replaces_an_older_one(tmp_path: Path, outcome_table: Any) -> None:
    run = plain_run(tmp_path / "run", outcome_table(6, 4, 2))
    path = tmp_path / "new" / "report.html"
    assert write_report([run], path) == path
    path.write_text("old", encoding="utf-8")
    write_report([run], path)
    assert path.read_text(encoding="utf-8").rstrip().endswith("</html>")
    assert list(path.parent.iterdir()) == [path], "no draft stays behind"


@pytest.mark.slow
def test_making_a_report_imports_neither_simulator_nor_model(tmp_path: Path, outcome_table: Any) -> None:
    outcome_table(6, 4, 2).to_json(tmp_path / "episodes.json")
    code = f"""
import sys
from pathlib import Path
import pandas as pd
from probe_kit.retention.report import write_report
from probe_kit.train import ArrayRun, load_results
from probe_kit.train.results.control_scores import Controls
from probe_kit.train.results.store import save_results
episodes = pd.read_json({str(tmp_path / "episodes.json")!r})
write_report([ArrayRun(Path({str(tmp_path)!r}), "pi0", "suite", episodes, {{}})], {str(tmp_path / "r.html")!r})
print([name for name in ("torch", "pybullet", "lerobot", "transformers") if name in sys.modules])
"""
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True)
    assert loaded.stdout.strip() == "[]"


def titled(rows: Any, title: str) -> Table | None:
    return retention_tables(rows).get(title)


# -- tables and words ------------------------------------------------------------------------------------------


def test_cells_sort_by_the_rows_numbers_and_show_them_in_percent(probed_run: ProbedRun) -> None:
    table = retention_table([probed_run({"color": SIGNAL, "shape": NOISE})])
    titled_table = titled(table.all_rows, "Success rate")
    assert titled_table is not None
    assert titled_table.columns[:2] == ("category", "SR % [95 %]"), "one run: no model"
    success = titled_table.rows[0].cells[1]
    assert success.sort == table.rows[0].success.sr == 0.6
    assert success.text.startswith("60.0 [")
    assert not success.strong, "its interval holds one half"
    assert [row.cells[0].text for row in titled_table.rows if row.is_mean] == ["Mean"]


def test_retention_without_backbone_signal_is_shown_as_such_and_sorts_last(probed_run: ProbedRun) -> None:
    titled_table = titled(retention_table([probed_run({"color": SIGNAL, "shape": NOISE})]).all_rows, "Retention")
    assert titled_table is not None
    position = titled_table.columns.index("retention [95 %]")
    color, shape, _ = (row.cells[position] for row in titled_table.rows)
    assert color.heat is not None
    assert (shape.text, shape.sort, shape.heat) == ("n/a", None, None)
    assert shape.note.startswith("n/a (backbone absent, at most ")


def test_a_leak_is_red_and_named_in_the_warnings(probed_run: ProbedRun) -> None:
    table = retention_table([probed_run({"color": SIGNAL})])
    leaking = {"baselines": {"pixels": 0.8}, "leaks": ("pixels",)}
    rows = [replace(row, controls=replace(row.controls, **leaking)) for row in table.all_rows]
    titled_table = titled(rows, "Controls")
    assert titled_table is not None
    assert any(cell.alarm and cell.text.startswith("80.0") for cell in titled_table.rows[0].cells)
    assert any("pixels" in warning for warning in warnings_of(rows[-1], rows[:-1]))
    assert titled(table.all_rows, "Controls") is None


def test_every_heading_says_what_it_means(probed_run: ProbedRun) -> None:
    rows = retention_table([probed_run({"color": SIGNAL, "shape": NOISE})]).all_rows
    for titled_table in retention_tables(rows).values():
        assert all(len(heading.help) > 10 for heading in titled_table.headings)


def test_the_mean_of_scores_is_free_of_the_luck_of_the_best_site(probed_run: ProbedRun) -> None:
    table = retention_table([probed_run({"color": SIGNAL, "shape": NOISE, "time": SIGNAL})])
    score = table.means[0].backbone.score
    assert score is not None
    assert 0.75 < score < 0.775, "two of 90 % and one that guesses"


def test_why_there_is_no_retention_is_the_reason_that_there_is(probed_run: ProbedRun) -> None:
    """Categories that were not probed lack no signal, and neither do those that nothing was permuted for."""
    run = probed_run({"color": SIGNAL, "shape": SIGNAL})
    results = load_results(run)
    only = replace(results.settings, categories=("color",), seed=1)
    curves = {curve_key: curve for curve_key, curve in results.curves.items() if curve_key[0] == "color"}
    some = replace(results, settings=only, curves=curves, controls=Controls())
    save_results(some, run.path)
    table = retention_table([run])
    note = {row.category: row.retention.note for row in table.rows}
    assert note["shape"] == f"n/a (probes {some.key} are of color)"
    untested = {curve_key: replace(curve, null=curve.null[:, :0]) for curve_key, curve in results.curves.items()}
    save_results(replace(results, settings=replace(results.settings, seed=2), curves=untested), run.path)
    assert retention_table([run]).rows[0].retention.note == "n/a (no permutations)"


def test_every_mark_of_evidence_is_said_to_need_the_controls_too(probed_run: ProbedRun) -> None:
    """A caption that asks for chance alone calls an untrained conjunction evidence."""
    runs = [probed_run({"color": SIGNAL, "shape": NOISE}, name) for name in ("one", "other")]
    table = retention_table(runs)
    readings = [
        shown_exhibit.reading
        for shown_exhibit in collect_figures(runs, table)
        if shown_exhibit.subject == "probes"
    ]
    marked = [reading for reading in readings if "illed marker" in reading or "Dots" in reading]
    assert len(marked) > 4
    assert all("every control" in reading for reading in marked)
    assert "every control" in TERMS["n/a"]


def test_a_policy_that_never_grasps_is_not_said_to_fail_at_knowing(tmp_path: Path, outcome_table: Any) -> None:
    table: RetentionTable = retention_table(
        [plain_run(tmp_path, outcome_table(0, 2, 10).assign(never_moved=True))]
    )
    (warning,) = warnings_of(table.means[0], table.rows)
    assert "does not grasp" in warning


def test_the_citation_names_weights_and_suite(probed_run: ProbedRun) -> None:
    sentence, bibtex = citation([probed_run({"color": SIGNAL})])
    assert "suite@1#0123456789ab" in sentence
    assert "2606.19297" in bibtex


@pytest.mark.slow
def test_the_citation_of_recordings_names_neither_the_scene_nor_its_protocol(tmp_path: Path) -> None:
    sentence, bibtex = citation([write_recorded_run(tmp_path / "run")])
    assert "probe_kit" in sentence
    for text in (sentence, bibtex):
        assert not re.search("Act2Answer|PyBullet|2606", text, re.IGNORECASE)


def test_every_word_has_a_sentence() -> None:
    columns = [column.help for modes in get_args(Modes) for column in all_columns(modes)]
    words = HEADING_HELP | VERDICT_HELP | TERMS
    assert all(meaning.endswith(".") for meaning in (*columns, *words.values()))


def test_every_verdict_is_explained() -> None:
    assert set(VERDICT_HELP) == {*get_args(Readable), *get_args(Behaviour)}


# -- episodes --------------------------------------------------------------------------------------------------


def framed_run(folder: Path, episodes: pd.DataFrame) -> ArrayRun:
    run = plain_run(folder, episodes)
    for number in range(len(episodes)):
        frame = np.full((12, 16, 3), 3 * number, np.uint8)
        locate(folder).write(thumbnail_key(number), as_thumbnail((frame, frame)))
    return run


def test_all_episodes_have_their_pictures_up_to_the_limit(tmp_path: Path, outcome_table: Any) -> None:
    run = framed_run(tmp_path, outcome_table(6, 4, 2))
    grid = episode_grid([run], ["run"], pictures=12)
    assert len(grid.cards) == 12
    assert [card["picture"] for card in grid.cards] == list(range(12))
    assert len(grid.pictures[0]) == 12
    assert grid.note == ""


def test_above_the_limit_whole_items_keep_their_pictures_and_the_page_says_so(
    tmp_path: Path, outcome_table: Any
) -> None:
    run = framed_run(tmp_path, outcome_table(6, 4, 2))
    grid = episode_grid([run], ["run"], pictures=5)
    pictured_items = [card["id"].split(":")[0] for card in grid.cards if card["picture"] is not None]
    assert pictured_items == ["color-0", "color-0", "color-3", "color-3"]
    assert len(grid.cards) == 12
    assert grid.note.startswith("Pictures of 4 of 12 episodes")


def test_pictures_of_all_episodes_together_are_bounded_in_bytes(tmp_path: Path, outcome_table: Any) -> None:
    run = framed_run(tmp_path, outcome_table(6, 4, 2))
    sizes = [len(read_thumbnail(tmp_path, number) or b"") for number in range(12)]
    most = sum(sizes[:5])
    grid = episode_grid([run], ["run"], picture_bytes=most)
    pictures = [b64decode(picture) for block in grid.pictures for picture in block]
    assert [card["picture"] is not None for card in grid.cards[:8]] == [True, True, *[False] * 4, True, True]
    assert [len(picture) for picture in pictures] == [sizes[0], sizes[1], sizes[6], sizes[7]]
    assert f"{most / 1e6:.0f} MB" in grid.note
    alone = episode_grid([run], ["run"], picture_bytes=1)
    assert sum(card["picture"] is not None for card in alone.cards) == 2, "one question is always shown"


def test_the_page_holds_pictures_in_blocks_that_cards_point_to(tmp_path: Path, outcome_table: Any) -> None:
    run = framed_run(tmp_path, outcome_table(BLOCK, 4, 2))
    page = report_html([run])
    scripts = re.findall(r'<script type="application/json" class="pictures">(.*?)</script>', page, re.DOTALL)
    blocks = [json.loads(block) for block in scripts]
    assert [len(block) for block in blocks] == [BLOCK, 6]
    assert f'data-block="{BLOCK}"' in page
    for card in cards(page):
        block, position = divmod(card["picture"], BLOCK)
        number = int(run.episodes.index[run.episodes["episode_id"] == card["id"]][0])
        assert b64decode(blocks[block][position]) == read_thumbnail(tmp_path, number)


def test_runs_without_frames_say_so(tmp_path: Path, outcome_table: Any) -> None:
    grid = episode_grid([plain_run(tmp_path, outcome_table(6, 4, 2))], ["run"])
    assert "keep no frames" in grid.note


@pytest.mark.slow
@pytest.mark.parametrize("moves_first", [True, False])
def test_page_terminal_markdown_and_json_say_the_same_sentence_of_both_readouts(
    probed_run: ProbedRun, moves_first: bool
) -> None:
    """The answer decides over the whole episode, and in the first chunk or not."""
    run = probed_run({"color": SIGNAL, "shape": SIGNAL})
    still = np.full(48, 0.1), np.full(48, 0.1)
    for readout, color in (("first-chunk", follower(48) if moves_first else still), ("per-step", follower(48))):
        settings = {
            "format": FORMAT, "kind": "image-swap", "run_settings": run.settings_sha256, "stamp": "",
            "wording": None, "categories": ["color", "shape"], "readout": readout,
        }  # fmt: skip
        outcomes = outcomes_of({"color": color, "shape": follower(48)})
        store_outcomes(run.location, run.suite, settings, outcomes)
    table = retention_table([run])
    (stored,) = (row for row in json.loads(table.to_json()) if row["category"] == "color")
    sentence, verdict = stored["conclusion"], stored["verdict"]
    if moves_first:
        assert verdict == "used"
        assert "is used in the first chunk and over the whole episode" in sentence
    else:
        assert verdict == "first chunk not used; episode used"
        assert "is not used in the first chunk: " in sentence
        assert "; it is used over the whole episode" in sentence
    with (console := Console(width=400)).capture() as printed:
        console.print(table.to_rich("all"))
    page = unescape(re.sub(r"<[^>]+>", " ", report_html([run])))
    for rendering in (printed.get(), table.to_markdown(), page):
        text = " ".join(rendering.replace("\u00a0", " ").split())
        assert sentence in text
        assert verdict in text


SVG = "{http://www.w3.org/2000/svg}"


def drawing(points: int = 40) -> Figure:
    """A curve, hatched bars and words."""
    figure = Figure(figsize=(4, 3))
    axes = figure.subplots()
    axes.plot(np.linspace(0, 1, points), np.random.default_rng(0).random(points), marker="o")
    axes.bar([0.2, 0.6], [0.5, 0.7], 0.2, hatch="///", color="#56B4E9")
    axes.set_title("checkpoint of /home/jane/models/mine & more")
    return figure


def exhibit(points: int = 40) -> ReportFigure:
    return ReportFigure("name", "title", "behaviour", "Reading.", None, lambda: drawing(points))


def svg_of(figure: Figure) -> bytes:
    file = BytesIO()
    with mpl.rc_context({"svg.hashsalt": "x", "svg.fonttype": "none"}):
        figure.savefig(file, format="svg")
    return file.getvalue()


def numbers(svg: ElementTree.Element, name: str) -> list[float]:
    texts = [element.attrib[name] for element in svg.iter() if name in element.attrib]
    return [float(number) for text in texts for number in re.findall(r"-?\d+(?:\.\d+)?", text)]


def test_a_compact_drawing_has_the_same_shapes_places_and_words() -> None:
    before = svg_of(drawing())
    after = compact_svg(before)
    assert len(after) < 0.8 * len(before)
    old, new = ElementTree.fromstring(before), ElementTree.fromstring(after)
    drawn = [
        element.tag for element in old.iter() if "metadata" not in element.tag and element.tag.startswith(SVG)
    ]
    assert [element.tag for element in new.iter()] == drawn
    for name in ("d", "x", "y"):
        assert numbers(new, name) == pytest.approx(numbers(old, name), abs=0.0051)
    words = [[element.text for element in svg.iter(f"{SVG}text")] for svg in (old, new)]
    assert words[0] == words[1] != []


def test_what_a_compact_drawing_refers_to_is_in_it() -> None:
    after = compact_svg(svg_of(drawing())).decode()
    used = set(re.findall(r"#([a-z][\w-]+)", after)) - set(re.findall(r"#([0-9a-f]{6})\b", after))
    assert used
    assert all(f'id="{name}"' in after for name in used)


def test_a_figure_is_vectors_with_a_transparent_ground_and_no_path() -> None:
    source, _ = data_uri(exhibit())
    kind, _, text = source.partition(",")
    assert kind == "data:image/svg+xml"
    assert '"' not in text
    root = ElementTree.fromstring(unquote(text))
    assert "checkpoint of mine & more" in [element.text for element in root.iter(f"{SVG}text")]
    assert "/home" not in unquote(text)
    ground = next(element for element in root.iter(f"{SVG}path"))
    assert "fill: none" in ground.attrib["style"] or "opacity: 0" in ground.attrib["style"]
    assert data_uri(exhibit())[0] == source, "the same figure, the same bytes"


def test_a_large_figure_is_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "SVG_LIMIT", 1000)
    source, _ = data_uri(exhibit())
    assert source.startswith("data:image/webp;base64,")
