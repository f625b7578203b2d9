"""Answer, probe, success as a figure and in the report."""

from pathlib import Path

import numpy as np

from probe_kit.retention import retention_table
from probe_kit.retention.behaviour import scored
from probe_kit.retention.columns.comparisons import known_used_tables
from probe_kit.retention.compare.known_used import match_runs
from probe_kit.retention.displays import KnownUsedDisplay, collect_figures
from probe_kit.retention.joins import joins_of
from probe_kit.retention.report import report_html
from tests.retention.asked_runs import SaidRun, acted, asked

KNOWN = {"color": np.array([[1, 1], [1, 1], [0, 1], [0, 0]], bool)}
USED = {"color": np.array([[1, 1], [0, 1], [1, 1], [0, 0]], bool)}


def pair(folder: Path) -> tuple[object, SaidRun]:
    return scored(asked(folder, KNOWN), "text"), acted(folder, USED)


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


def test_the_report_of_an_asked_and_an_acting_run_holds_their_join(tmp_path: Path) -> None:
    vlm, policy = pair(tmp_path)
    runs = [vlm, policy]
    table = retention_table(runs)  # type: ignore[arg-type]
    (joined,) = joins_of(runs, table).tables  # type: ignore[arg-type]
    assert [one.name for one in collect_figures(runs, table) if one.subject == "join"] == ["known-used-1"]  # type: ignore[arg-type]
    page = report_html(runs, table)  # type: ignore[arg-type]
    section = page.split('<details class="part" id="join">')[1].split("</details>")[0]
    for plain in known_used_tables(joined):
        assert plain.title in section
        for cells in plain.texts:
            assert all(f">{cell}<" in section for cell in cells if "[" not in cell)
    assert section.count("<img") == 1


def test_runs_that_saw_other_frames_are_not_joined_and_the_report_says_so(tmp_path: Path) -> None:
    vlm, policy = pair(tmp_path)
    policy.episodes["first_frame_sha256"] = "other"
    runs = [vlm, policy]
    table = retention_table(runs)  # type: ignore[arg-type]
    found = joins_of(runs, table)  # type: ignore[arg-type]
    assert found.tables == ()
    assert "begin with another frame" in found.refused[0]
    assert "begin with another frame" in report_html(runs, table)  # type: ignore[arg-type]


def test_acting_runs_alone_have_no_join(tmp_path: Path) -> None:
    _, policy = pair(tmp_path)
    assert 'id="join"' not in report_html([policy])
