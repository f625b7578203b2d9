"""What a terminal shows, parsed number by number."""

import io
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from rich.console import Console

from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.columns import summary
from probe_kit.retention.columns.sentences import VERDICT_HELP
from probe_kit.train import ArrayRun, BaselineScore, Controls, UntrainedScore, load_results, save_results

ProbedRun = Callable[..., ArrayRun]
SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7]])
NONE = ([0.5, 0.55, 0.5], [[0.58, 0.5]])
PERFECT = ([1.0, 1.0, 1.0], [[1.0, 1.0]])
WIDTHS = (24, 40, 60, 80, 100, 120, 160, 240)
"""Columns; 120 in a pipe."""


def printed(table: RetentionTable, width: int = 80) -> str:
    console = Console(width=width, file=io.StringIO())
    console.print(table.to_rich("all"))
    return console.file.getvalue()  # type: ignore[attr-defined,no-any-return]


@pytest.fixture
def table(probed_run: ProbedRun) -> RetentionTable:
    """Wide numbers: long names, 100 %, negative limits, controls, an untrained network, two groups."""
    accuracies = {"facial_emotion": SIGNAL, "traffic_sign": PERFECT, "counting": NONE}
    runs = [probed_run(accuracies, name) for name in ("one", "other")]
    for run in runs:
        results = load_results(run)
        controls = Controls(
            tuple(
                BaselineScore(name, category, 0.4625, (0.4, 0.5), 0.4, 0.5, 200)
                for name in ("position", "instruction", "pixels")
                for category in accuracies
            ),
            tuple(
                UntrainedScore(category, "mean", site, site, True, 0.9, 1.0, -0.1, (-0.2345, -0.0123), "untrained")
                for site in ("backbone.01.residual", "expert.01.residual@0")
                for category in accuracies
            ),
        )
        save_results(replace(results, controls=controls), run.path)
    return retention_table({"first": [runs[0]], "second": [runs[1]]})


def numbers(text: str) -> list[float]:
    return [float(found) for found in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?", text.replace("−", "-"))]


LINE = re.compile(r"(facial_emotion|traffic_sign|counting|mean) (A|B|B − A)")


def blocks(text: str) -> Iterator[tuple[str, dict[tuple[str, str], list[float]]]]:
    """Title and, by category and run, all numbers of the block in order, from however many tables it has."""
    for block in re.split(r"\n(?=Success rate: )|\n(?=(?:Retention|Controls),)", text):
        found: dict[tuple[str, str], list[float]] = {}
        for line in block.splitlines():
            name, *cells = re.split(r" {2,}", line.strip())
            if cells and (whose := LINE.fullmatch(name)):
                found.setdefault((whose[1], whose[2]), []).extend(one for cell in cells for one in numbers(cell))
        yield block.splitlines()[0], found


def rounded(values: list[object], scales: list[tuple[float, int]]) -> list[float]:
    """What a table shows of json values: None and undefined ones are left out, intervals are flat."""
    shown = []
    for value, (scale, digits) in zip(values, scales, strict=True):
        parts = value if isinstance(value, list) else [value]
        shown += [round(scale * one, digits) for one in parts if one is not None]
    return shown


SHARE, RATIO, WHOLE, PLACE, P = (100, 1), (1, 2), (100, 0), (1, 0), (1, 3)


RETENTIONS = ("value", "ci", "published")


def could_be(stream: dict[str, object]) -> object:
    """The limit that a verdict names; one that is shown needs none."""
    return None if stream["verdict"] == "shown" else stream["at_most"]


def expected(row: dict[str, dict[str, object]]) -> dict[str, list[float]]:
    success, backbone, action, controls = (row[name] for name in ("success", "backbone", "action", "controls"))
    defined = bool(row["retention"]["defined"])
    return {
        "Success": rounded(
            [
                *(success[name] for name in ("sr", "ci", "chance_margin", "chance_margin_episodes")),
                *(success[name] for name in ("normalised_score", "sr_left", "sr_right")),
                *(success[name] for name in ("share_wrong", "share_outside")),
            ],
            [SHARE, SHARE, SHARE, SHARE, (1, 1), SHARE, SHARE, SHARE, SHARE],
        ),
        "Retention": rounded(
            [
                *(row["retention"][name] if defined else None for name in RETENTIONS),
                controls["probe_minus_sr"],
                *(backbone[name] for name in ("score", "ci")),
                could_be(backbone),
                backbone["layer"],
                backbone["ties"] or None,
                backbone["p_fwe"],
                *(action[name] for name in ("score", "ci")),
                could_be(action),
                *(action[name] for name in ("layer", "iteration")),
                action["ties"] or None,
                *(action[name] for name in ("p_fwe", "first_peak")),
            ],
            [
                *[RATIO] * 3,
                SHARE,
                SHARE,
                SHARE,
                WHOLE,
                PLACE,
                PLACE,
                P,
                SHARE,
                SHARE,
                WHOLE,
                PLACE,
                PLACE,
                PLACE,
                P,
                SHARE,
            ],
        ),
        "Controls": rounded(
            [
                *(controls["baselines"][name] for name in ("position", "instruction", "pixels")),  # type: ignore[index]
                *(stream["selectivity"] for stream in (backbone, action)),
                *(
                    stream[name]
                    for stream in (backbone, action)
                    for name in ("minus_untrained", "minus_untrained_ci")
                ),
            ],
            [SHARE] * 9,
        ),
    }


@pytest.mark.parametrize("width", [width for width in WIDTHS if width >= 60])
def test_every_number_can_be_read_back_at_every_width(table: RetentionTable, width: int) -> None:
    text = printed(table, width)
    rows = json.loads(table.to_json())["rows"]
    found = [block for block in blocks(text) if block[1]]
    assert len(found) == 3
    for letter, of_run in (("A", rows[:4]), ("B", rows[4:])):
        for title, block in found:
            for row in of_run:
                wanted = next(values for name, values in expected(row).items() if title.startswith(name))
                place = row["category"], letter
                assert block[place] == pytest.approx(wanted, abs=1e-9), (title, place)
    (difference,) = [row for row in table.differences if row.category == "mean"]
    told = found[0][1]["mean", "B − A"]
    assert told == pytest.approx([0.0, *(round(100 * x, 1) for x in difference.sr_ci), 1.0, 1.0])
    told = found[1][1]["mean", "B − A"]
    start = [0.0, *(round(100 * x, 1) for x in difference.backbone_ci)]
    assert any(told[at : at + 3] == pytest.approx(start) for at in range(len(told)))


@pytest.mark.parametrize("width", WIDTHS)
def test_no_width_crops_anything_or_runs_over(table: RetentionTable, width: int) -> None:
    text = printed(table, width)
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    row = table.rows[1]
    low, high = (f"{100 * limit:.1f}" for limit in row.backbone.ci)  # type: ignore[union-attr,operator]
    assert f"100.0 [{low}, {high}]" in text


def test_a_wide_terminal_has_one_table_per_subject(table: RetentionTable) -> None:
    headings = [line for line in printed(table, 300).splitlines() if line.startswith("category ")]
    assert len(headings) == 3 + 1, "and the summary"


def test_headings_are_the_same_in_every_format(table: RetentionTable) -> None:
    from probe_kit.retention.columns.tables import tables_of
    from probe_kit.retention.formats.html import html_tables

    rows = table.all_rows
    pages = [
        column.name.replace("\u00a0", " ")
        for one in html_tables(rows, table.differences)
        for column in one.columns
    ]
    texts = {"terminal": printed(table, 300), "markdown": table.to_markdown(), "latex": table.to_latex("all")}
    texts["latex"] = (
        texts["latex"].replace(r"\,\%", " %").replace("$-$", "−").replace(r"$\pm$", "±").replace(r"$\Delta$", "Δ")
    )
    for one in tables_of(rows, table.differences):
        for column in one.columns:
            assert column.heading in pages
            assert f" {column.heading} |" in texts["markdown"]
            assert not re.search("prefix|expert", column.heading)
        for column in one.without_details().columns:
            assert column.heading in texts["terminal"]
            assert f"& {column.heading}" in texts["latex"]


def test_every_title_marks_random_weights(probed_run: ProbedRun) -> None:
    text = printed(retention_table([probed_run({"color": SIGNAL}, "pi0-tiny", random_weights=True)]))
    assert text.count("pi0-tiny (random weights) on") == 2


def test_the_caption_says_why_retention_is_missing(probed_run: ProbedRun) -> None:
    text = printed(retention_table([probed_run({"color": SIGNAL, "counting": NONE})]))
    assert "n/a (backbone absent, at most" in " ".join(text.split())
    assert "published ratios without counting" in " ".join(text.split())


def test_several_runs_stand_in_one_table_under_a_title_that_names_all(probed_run: ProbedRun) -> None:
    text = printed(
        retention_table([probed_run({"color": SIGNAL}, "pi0"), probed_run({"color": SIGNAL}, "smolvla")]), 160
    )
    for what in ("Success rate", "Retention, view mean"):
        assert text.count(f"{what}: A pi0, B smolvla on suite@1#0123456789ab") == 1
    lines = [line.split("  ")[0] for line in text.splitlines() if line.startswith(("color ", "mean "))]
    assert lines[:6] == ["color A", "color B", "color B − A", "mean A", "mean B", "mean B − A"]


def test_a_policy_without_an_expert_has_the_same_columns(probed_run: ProbedRun) -> None:
    runs = [probed_run({"color": SIGNAL}, "openvla", action_stream="action"), probed_run({"color": SIGNAL}, "pi0")]
    table = retention_table(runs)
    assert [row.run.action_stream for row in (*table.rows, *table.means)] == ["action", "expert"] * 2
    assert [row.retention.value for row in table.rows] == [table.rows[0].retention.value] * 2 != [None, None]
    headings = [line for line in printed(table, 160).splitlines() if "backbone % [95 %]" in line]
    assert len(headings) == 1


@pytest.mark.parametrize("words", sorted(VERDICT_HELP, key=len)[-6:])
@pytest.mark.parametrize(("width", "lines"), [(80, 2), (100, 1), (120, 1)])
def test_the_summary_has_its_intervals_on_a_usual_console_whatever_the_verdict(
    probed_run: ProbedRun, monkeypatch: pytest.MonkeyPatch, words: str, width: int, lines: int
) -> None:
    """A line per category where there is room, else two: a value and below it the limits."""
    monkeypatch.setattr(summary, "verdict", lambda _: words)
    table = retention_table([probed_run({"color": SIGNAL, "counting": NONE})])
    whole = printed_summary(table, width)
    assert max(map(len, whole)) <= width
    row = re.split(r"^Counting", "\n".join(whole).partition("Color")[2], flags=re.MULTILINE)[0]
    assert len(row.splitlines()) == lines
    (found,) = (one for one in table.rows if one.category == "color")
    assert found.success.ci
    for limits in (found.backbone.ci, found.action.ci, found.success.ci):
        low, high = (round(100 * limit) for limit in limits or () if limit is not None)
        assert f"[{low}, {high}]" in row
    assert "".join(re.findall(r"[a-z]+", words)) in "".join(re.findall(r"[a-z]+", row))


def printed_summary(table: RetentionTable, width: int) -> list[str]:
    """The lines of the last table, from its title on."""
    console = Console(width=width, file=io.StringIO())
    console.print(table.to_rich())
    text = console.file.getvalue()  # type: ignore[attr-defined]
    return str(text).partition("Summary: ")[2].partition("\n\n")[0].splitlines()
