"""The README's lines run as typed, and its numbers are those of the demo."""

import ast
import contextlib
import json
import re
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

import probe_kit as pk
from tests.acceptance.product import ROOT, address_of, environment, lines_of, probe_kit, served_page

README = (ROOT / "README.md").read_text(encoding="utf-8")
DEMO: dict[str, Any] = json.loads((ROOT / "docs" / "demo.json").read_text(encoding="utf-8"))
TRAINED = {row["category"]: row for row in DEMO["demo"]["organisms"]}
TYPED = "## Your own study"


def cells_of_the_table() -> dict[str, list[str]]:
    """The cells of the README's table of the demo, by category."""
    (block,) = re.findall(r"<!-- from docs/demo.json: trained -->(.*?)<!-- end of it -->", README, re.DOTALL)
    rows = [[cell.strip() for cell in line.strip(" |").split("|")] for line in block.splitlines() if "|" in line]
    return {row[0].casefold(): row[1:] for row in rows[2:]}


def numbers(cell: str) -> list[float]:
    """All numbers of a cell, with either minus sign."""
    return [float(text) for text in re.findall(r"-?\d+(?:\.\d+)?", cell.replace("−", "-"))]


@pytest.mark.parametrize("category", TRAINED)
def test_the_readme_shows_the_numbers_of_the_demo(category: str) -> None:
    items, rate, backbone, action, retention = cells_of_the_table()[category]
    row = TRAINED[category]
    assert numbers(items) == [row["items"]]
    assert numbers(rate) == [pytest.approx(100 * row["sr"], abs=0.06)]
    score, low, high, *_ = numbers(backbone)
    assert score == pytest.approx(100 * row["backbone"], abs=0.06)
    assert [low, high] == pytest.approx([100 * bound for bound in row["backbone_ci"]], abs=0.06)
    assert ("not shown" in backbone) == (row["verdict"] == "not shown")
    assert numbers(action) == [pytest.approx(100 * row["action"], abs=0.06)]
    if row["retention"] is None:
        assert retention == "n/a"
    else:
        expected = [row["retention"], *row["retention_ci"]]
        assert numbers(retention) == pytest.approx(expected, abs=0.006)


def test_the_demo_says_what_its_policy_was_trained_for() -> None:
    """The policy acts on Color and Shape. State is decodable and is not used. Counting is not shown."""
    compared = {row["category"]: row for row in DEMO["compare"]["organisms"] if row["organism"] == "trained"}
    assert {name for name, row in TRAINED.items() if row["verdict"] == "shown"} == {"color", "state"}
    assert {name for name, row in compared.items() if row["verdict"] == "shown"} == {"color", "shape", "state"}
    assert min(TRAINED["color"]["retention"], compared["color"]["retention"], compared["shape"]["retention"]) > 0.7
    for rows in (TRAINED, compared):
        assert rows["color"]["measured"] == "used"
        assert rows["state"]["measured"] == "not used"
        assert rows["state"]["retention"] < 0.5
        assert rows["counting"]["retention"] is None
    for row in DEMO["demo"]["organisms"] + DEMO["compare"]["organisms"]:
        assert row["backbone_ci"][0] <= row["backbone"] <= row["backbone_ci"][1]
        assert row["agreement"] != "wrong", row


@pytest.mark.slow
def test_the_demo_runs_and_gives_the_documented_numbers(tmp_path: Path) -> None:
    (line,) = [line for line in lines_of("README.md", "## Two commands") if "demo" in line]
    printed = shell(line.replace("./with-uv ", ""), tmp_path)
    for picture in ("*.png", "*.gif", "*.html"):
        assert list((tmp_path / "probe-kit-demo").rglob(picture)), f"the demo writes no {picture}"
    for category, row in TRAINED.items():
        (cells,) = [text for text in printed.splitlines() if text.casefold().startswith(category)][:1]
        assert round(100 * row["sr"]) in numbers(cells), cells
    runs = [path.parent for path in (tmp_path / "probe-kit-demo").rglob("run.json")]
    acted = [run for run in map(pk.open_run, runs) if run.model.startswith("pi0")]
    assert len(acted) == 1
    table = probe_kit("retention", acted[0].path, "--format", "csv").rows()
    for line_ in table:
        row = TRAINED.get(line_.get("category", ""))
        if row is not None and line_.get("sr"):
            assert float(line_["sr"]) == pytest.approx(row["sr"])


@pytest.mark.slow
def test_the_installation_is_checked_line_by_line() -> None:
    assert "python" in probe_kit("doctor", code=None).text.casefold()


def test_the_two_commands_are_there() -> None:
    lines = lines_of("README.md", "## Two commands")
    assert [line.split()[-1] for line in lines] == ["probe_kit", "demo", "pytest"]
    for command in ("demo", "doctor", "models", "verify"):
        assert probe_kit(command, "--help").out
    assert "pi0-tiny" in probe_kit("models").text


def test_every_line_of_a_study_is_a_command_that_asks_only_for_the_run_of_the_first(tmp_path: Path) -> None:
    _, first, *others = lines_of("README.md", TYPED)
    assert first.startswith("probe-kit extract")
    assert len(others) == 4
    with contextlib.chdir(tmp_path):
        fewer = ("--categories", "color", "--items", "2")
        assert "episodes" in probe_kit(*first.split()[1:], *fewer, "--dry-run").text
        for line in others:
            assert "runs/mine" in probe_kit(*line.split()[1:], code=2).text
    assert list(tmp_path.iterdir()) == []


def test_the_python_example_uses_public_names_only() -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names = {
        node.attr
        for node in ast.walk(ast.parse(example))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "pk"
    }
    assert names
    assert names <= set(pk.__all__)


@pytest.mark.slow
def test_the_python_example_runs_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    with contextlib.chdir(tmp_path):
        exec(compile(example, "README", "exec"), {"__name__": "__main__"})
    printed = capsys.readouterr().out
    assert "(24, 96) float32" in printed
    assert "color" in printed.casefold()
    assert (tmp_path / "layer-curves.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_lines_of_a_study_run_as_typed_and_the_viewer_answers_until_ctrl_c(tmp_path: Path) -> None:
    *lines, view = lines_of("README.md", TYPED)
    for line in lines[1:]:
        shell(line, tmp_path)
    assert (tmp_path / "report.html").stat().st_size > 10_000
    assert list((tmp_path / "figures").glob("*.png"))
    assert view.startswith("probe-kit view")
    viewer = subprocess.Popen(
        [*view.split(), "--no-browser"],
        cwd=tmp_path,
        env=environment(PYTHONUNBUFFERED="1"),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
    )
    try:
        assert "<html" in served_page(address_of(viewer))
    finally:
        viewer.send_signal(signal.SIGINT)
        viewer.communicate(timeout=60)
    assert viewer.returncode in (0, 130)


def shell(line: str, folder: Path) -> str:
    """What a line prints that is typed in `folder`, with an empty cache. Fails unless it ends with 0."""
    ended = subprocess.run(
        ["bash", "-c", line],
        cwd=folder,
        env=environment(PROBE_KIT_CACHE=str(folder / "cache"), HOME=str(folder), COLUMNS="160"),
        capture_output=True,
        encoding="utf-8",
        check=False,
        timeout=3000,
    )
    assert ended.returncode == 0, f"{line}\n{ended.stdout}{ended.stderr}"
    return ended.stdout
