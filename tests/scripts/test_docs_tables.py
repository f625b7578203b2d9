"""The numbers of README and docs are those of `docs/demo.json`, which one script writes from one run."""

import json
import re
from pathlib import Path

import pytest
from docs_tables import DATA, PAGES, README, blocks, filled
from PIL import Image
from readme_picture import MADE_FROM, TARGET

from probe_kit.demo.pipeline import FULL, QUICK

DOCS = DATA.parent
FIGURE = re.compile(r"\d[\d,.]*\s?(%|×|ms|s\b|MB/s|GB\b)")


@pytest.mark.parametrize("page", [README, *PAGES], ids=lambda page: page.name)
def test_every_table_of_the_demo_is_the_one_its_numbers_make(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert blocks(text)
    assert filled(text, json.loads(DATA.read_text(encoding="utf-8"))) == text


def test_another_number_makes_another_page() -> None:
    data = json.loads(DATA.read_text(encoding="utf-8"))
    data["demo"]["organisms"][0]["sr"] = 0.123
    text = README.read_text(encoding="utf-8")
    assert "12.3" in filled(text, data)
    assert "12.3" not in text


def test_the_picture_shows_the_probes_whose_numbers_are_printed() -> None:
    data = json.loads(DATA.read_text(encoding="utf-8"))
    with Image.open(TARGET) as picture:
        assert picture.info[MADE_FROM] == data["demo"]["probes"]
    assert {row["organism"] for row in data["demo"]["organisms"]} == {"trained"}


def test_the_numbers_are_those_of_the_present_size_of_the_demo() -> None:
    data = json.loads(DATA.read_text(encoding="utf-8"))
    for name, size in {"demo": QUICK, "compare": FULL}.items():
        assert data[name]["permutations"] == size.permutations
        assert {row["category"]: row["items"] for row in data[name]["organisms"]} == dict(size.items)


@pytest.fixture(scope="module")
def sample() -> str:
    return (DOCS / "sample-report.html").read_text(encoding="utf-8")


def test_the_sample_report_has_at_most_one_megabyte_and_no_path(sample: str) -> None:
    assert len(sample.encode()) <= 1_000_000
    assert re.findall(r"(?<![\w.])/(?:home|tmp|work|root|Users)/", sample) == []


def test_the_sample_report_is_of_the_probes_and_numbers_that_are_printed(sample: str) -> None:
    data = json.loads(DATA.read_text(encoding="utf-8"))["demo"]
    assert f"probes {data['probes']}" in sample
    for row in data["organisms"]:
        cells = re.search(rf"<tr>\s*<td[^>]*>{row['category'].title()}</td>.*?</tr>", sample, re.DOTALL)
        assert cells, row["category"]
        printed = dict(re.findall(r'data-heading="(\w+)[^"]*" data-sort="([^"]+)"', cells[0]))
        keys = {"backbone": "backbone", "success": "sr", "action": "action"}
        assert {name: round(float(printed[name]), 4) for name in keys} == {
            name: round(row[key], 4) for name, key in keys.items()
        }
        retention = row["retention"]
        sorts_by = printed.get("retention", "n/a")
        assert sorts_by == "n/a" if retention is None else float(sorts_by) == pytest.approx(retention, abs=1e-3)


def test_the_controls_of_the_sample_report_are_those_of_the_demo(sample: str) -> None:
    """`demo --compare` adds an untrained network to the controls of the same run."""
    assert "random-features" in sample
    assert "untrained\u00a0%" not in sample
    assert "untrained network" not in sample


def test_no_page_repeats_the_demos_numbers_outside_its_tables() -> None:
    """A number in two places is soon two numbers."""
    data = json.loads(DATA.read_text(encoding="utf-8"))
    rows = data["demo"]["organisms"] + data["compare"]["organisms"]
    rates = {f"{100 * row['sr']:.1f}" for row in rows if 0.5 < row["sr"] < 1}
    assert rates
    for page in (README, DOCS / "index.md", *PAGES):
        text = re.sub(
            r"<!-- from docs/demo.json.*?<!-- end of it -->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL
        )
        assert [rate for rate in rates if re.search(rf"(?<![\d.]){re.escape(rate)}(?!\d)", text)] == [], page.name


def test_the_overview_of_performance_points_to_figures_and_holds_none() -> None:
    text = (DOCS / "notes" / "performance.md").read_text(encoding="utf-8").partition("\n## ")[0]
    assert [match[0] for match in FIGURE.finditer(text)] == []
    assert text.count("](") >= 6


def test_parameters_of_the_embedded_models_are_said_as_they_are_everywhere() -> None:
    """Counted in the files of their weights."""
    from safetensors import safe_open

    import probe_kit

    counts = set()
    for name in ("pi0-tiny", "vlm-tiny"):
        weights = Path(probe_kit.__file__).parent / "models" / "checkpoints" / name / "model.safetensors"
        with safe_open(weights, "np") as file:
            counts.add(sum(file.get_tensor(name).size for name in file.keys()))  # noqa: SIM118
    root = README.parent
    pages = [README, *DOCS.glob("*.md"), *root.glob("notebooks/*.ipynb"), *root.glob("probe_kit/**/*.py")]
    figures = {
        (page.name, figure)
        for page in pages
        for figure in re.findall(r"(0\.\d+)\s+million\s+param", page.read_text(encoding="utf-8"))
    }
    assert {figure for _, figure in figures} == {f"{count / 1e6:.2f}" for count in counts}, figures
