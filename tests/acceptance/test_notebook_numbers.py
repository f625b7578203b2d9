"""The notebooks' committed numbers: those that a fresh execution prints."""

import contextlib
import io
import json
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.acceptance.product import ROOT

NOTEBOOKS = ROOT / "notebooks"
SERIES = (
    ("01-first-run", "02-layer-curves", "03-compare-models"),
    ("05-your-own-questions",),
    ("06-vlm-against-vla",),
    ("07-from-readable-to-used",),
    ("08-your-own-labels",),
    ("09-your-own-recordings",),
)
"""Notebooks by topic; those of one topic share what they make."""
TIMED = re.compile(r"\d[\d.,]* ?(?:s|ms|min|MB|kB|GB)\b|in \d+(?:\.\d+)? ?s|/[\w./-]+|[0-9a-f]{12,64}")
"""Durations, sizes, paths and hashes, which differ from machine to machine."""


def cells(name: str) -> list[dict[str, Any]]:
    held = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text(encoding="utf-8"))
    return [cell for cell in held["cells"] if cell["cell_type"] == "code"]


def text_of(cell: Any) -> str:
    """The text that a cell has printed or shows as its value, without pictures' descriptions."""
    texts = []
    for output in cell["outputs"]:
        if output["output_type"] == "stream":
            texts.append("".join(output["text"]))
        elif "image/png" not in output.get("data", {}):
            texts.append("".join(output.get("data", {}).get("text/plain", "")))
    return TIMED.sub("", "\n".join(texts)).strip()


def numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w])", text)]


def test_the_notebooks_are_these_and_hold_numbers_and_no_error() -> None:
    committed = {path.stem for path in NOTEBOOKS.glob("*.ipynb")}
    assert {name for series in SERIES for name in series} <= committed
    for name in committed:
        outputs = [output for cell in cells(name) for output in cell["outputs"]]
        assert outputs
        assert not [output for output in outputs if output["output_type"] == "error"], name


def test_the_first_cells_of_the_first_notebook_print_what_is_committed(tmp_path: Path) -> None:
    """Its suite, and its questions with their sides, executed in this process."""
    committed = cells("01-first-run")[:3]
    names: dict[str, Any] = {}
    with contextlib.chdir(tmp_path), contextlib.redirect_stdout(io.StringIO()) as printed:
        for cell in committed:
            exec(compile("".join(cell["source"]), "01-first-run", "exec"), names)
    expected = text_of(committed[2])
    assert "answer on the" in expected
    assert expected == printed.getvalue().strip()


@pytest.mark.slow
@pytest.mark.parametrize("series", SERIES, ids=lambda series: series[0])
def test_a_notebook_executed_anew_prints_its_committed_numbers(series: tuple[str, ...], tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    if series[0].startswith("09") and not (find_spec("datasets") and find_spec("av")):
        pytest.skip("the extra `datasets` is not installed")
    compared = 0
    for name in series:
        notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
        options = {"timeout": 1800, "resources": {"metadata": {"path": str(tmp_path)}}}
        nbclient.NotebookClient(notebook, **options).execute()
        fresh = [cell for cell in notebook.cells if cell.cell_type == "code"]
        for cell, before in zip(fresh, cells(name), strict=True):
            expected, now = numbers(text_of(before)), numbers(text_of(cell))
            compared += len(expected)
            assert now == pytest.approx(expected, abs=2e-4, rel=1e-3), f"{name}\n{cell.source}\n{text_of(cell)}"
    assert compared > 10
