"""The report and the viewer fetch nothing, show the values of the table, and escape names."""

import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

import probe_kit as pk
from tests.acceptance.product import address_of, console_script, environment, probe_kit, served_page
from tests.acceptance.stored.conftest import StoredRuns
from tests.acceptance.stored.printed_tables import Page, equal_as_printed, intervals, quantities_of
from tests.support.browser import CHROMIUM, WHY_SKIPPED, Browser

HOSTILE = """<script>alert("x")</script><img src=x onerror='alert(1)'>&amp;"""
FETCHING = ("src", "srcset", "poster", "data", "action", "formaction", "background", "href", "xlink:href")
OUTSIDE = re.compile(
    r"""(?:\bsrc|\bhref|\burl|\bimport|\bfetch)\s*[=(]?\s*["'(]\s*(?:https?:)?//""", re.IGNORECASE
)


@pytest.fixture(scope="module")
def hostile(runs: StoredRuns, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the trained run whose name in tables is a script."""
    copy = Path(shutil.copytree(runs.trained, tmp_path_factory.mktemp("hostile") / "a<b>&'c"))
    probe_kit("run", "show", copy, "--label", HOSTILE)
    return copy


@pytest.fixture(scope="module")
def report(hostile: Path, runs: StoredRuns, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of both policies, alone in a folder."""
    file = tmp_path_factory.mktemp("report") / "report.html"
    probe_kit("compare", hostile, runs.untrained, "--html", file)
    return file


def test_the_report_is_one_file_that_names_no_outside_address(report: Path) -> None:
    assert [path.name for path in report.parent.iterdir()] == ["report.html"]
    page = Page(report.read_text(encoding="utf-8"))
    addresses = [
        value
        for _, attributes in page.elements
        for name, value in attributes.items()
        if name in FETCHING and value
    ]
    assert any(address.startswith("data:image/") for address in addresses), "no picture of an episode"
    assert all(address.startswith(("#", "data:")) for address in addresses)
    assert not [tag for tag, attributes in page.elements if tag == "link" and "href" in attributes]
    policy = [attributes.get("content") for tag, attributes in page.elements if "http-equiv" in attributes]
    assert any("default-src 'none'" in (content or "") for content in policy)
    assert not OUTSIDE.search(report.read_text(encoding="utf-8"))


def test_the_report_shows_the_values_of_the_table(report: Path, hostile: Path, runs: StoredRuns) -> None:
    rows = probe_kit("compare", hostile, runs.untrained, "--format", "json").json()
    rows = rows["rows"] if isinstance(rows, dict) else rows
    page = Page(report.read_text(encoding="utf-8"))
    printed = intervals([[cell.replace("−", "-") for cell in row] for table in page.tables for row in table])
    compared = 0
    for row in rows:
        if row["category"] == "mean":
            continue
        for name, exact in quantities_of(row).items():
            compared += 1
            assert any(equal_as_printed(three, exact) for three in printed), (row["category"], name, exact)
    assert compared >= 9


def test_a_hostile_name_is_shown_as_text_and_runs_nothing(report: Path) -> None:
    content = report.read_text(encoding="utf-8")
    assert HOSTILE not in content
    page = Page(content)
    assert 'alert("x")' in page.text, "the name itself is to be read"
    assert not [attributes for _, attributes in page.elements if any(name.startswith("on") for name in attributes)]
    assert not [attributes for tag, attributes in page.elements if tag == "img" and attributes.get("src") == "x"]
    scripts = re.findall(r"<script[^>]*>(.*?)</script>", content, re.DOTALL)
    assert scripts
    assert not [script for script in scripts if script.lstrip().startswith('alert("x")')]


def test_the_same_runs_give_the_same_report_from_python(runs: StoredRuns, tmp_path: Path) -> None:
    probe_kit("retention", runs.expert, "--html", tmp_path / "first.html")
    pk.write_report([pk.open_run(runs.expert)], tmp_path / "second.html")
    assert (tmp_path / "first.html").read_bytes() == (tmp_path / "second.html").read_bytes()


def test_the_viewers_folder_needs_no_server_and_no_address(hostile: Path, tmp_path: Path) -> None:
    folder = tmp_path / "page"
    probe_kit("view", hostile, "--export", folder)
    index = folder / "index.html"
    page = Page(index.read_text(encoding="utf-8"))
    linked = [
        value
        for _, attributes in page.elements
        for name, value in attributes.items()
        if name in ("src", "href") and value and not value.startswith(("#", "data:"))
    ]
    assert linked
    assert all((folder / address).is_file() for address in linked)
    texts = [path for path in folder.rglob("*") if path.suffix in (".html", ".js", ".css")]
    assert not [path.name for path in texts if OUTSIDE.search(path.read_text(encoding="utf-8"))]
    assert not [
        path.name for path in texts if HOSTILE in path.read_text(encoding="utf-8") and path.suffix == ".html"
    ]
    assert list(folder.rglob("*.webp")), "no frame of an episode"


@pytest.mark.slow
def test_figures_are_written_as_png_and_pdf_that_open(runs: StoredRuns, tmp_path: Path) -> None:
    from PIL import Image

    probe_kit("compare", runs.trained, runs.untrained, "--figures", tmp_path, "--details", "all")
    names = {path.stem for path in tmp_path.glob("*.png")}
    assert len(names) > 8
    assert names == {path.stem for path in tmp_path.glob("*.pdf")}
    for path in tmp_path.glob("*.png"):
        with Image.open(path) as picture:
            picture.load()
            assert len(picture.convert("RGB").getcolors(1 << 24)) > 1, f"{path.name} is blank"
    assert all(path.read_bytes().startswith(b"%PDF") for path in tmp_path.glob("*.pdf"))


@pytest.fixture
def served(hostile: Path, runs: StoredRuns) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """The address of `probe-kit view`, and its process."""
    command = [str(console_script()), "view", str(hostile), str(runs.untrained), "--no-browser"]
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            env=environment(PYTHONUNBUFFERED="1"),
        )
    finally:
        signal.signal(signal.SIGINT, before)
    assert process.stdout is not None
    try:
        yield address_of(process), process
    finally:
        process.kill()
        process.wait(30)
        process.stdout.close()


@pytest.mark.slow
def test_the_viewers_server_answers_on_this_machine_until_ctrl_c(
    served: tuple[str, subprocess.Popen[str]],
) -> None:
    address, process = served
    assert re.match(r"http://(127\.0\.0\.1|localhost|\[::1\])", address)
    content = served_page(address)
    assert "<html" in content
    assert not OUTSIDE.search(content)
    with pytest.raises(HTTPError, match="403"):
        urlopen(address.partition("?")[0], timeout=30)  # another program of this machine, without the token
    process.send_signal(signal.SIGINT)
    assert process.wait(60) in (0, 130)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=WHY_SKIPPED)
def test_chromium_shows_the_viewer_and_the_report_without_a_complaint(
    served: tuple[str, subprocess.Popen[str]], report: Path, tmp_path: Path
) -> None:
    with Browser(tmp_path / "profile") as browser:
        page = browser.page()
        page.open(served[0])
        page.wait("document.body.innerText.includes('Color') || document.body.innerText.includes('color')")
        body: Any = page.read("document.body.innerText")
        assert 'alert("x")' in body
        assert "untrained" in body
        assert page.read("document.querySelectorAll('img[src=x]').length") == 0
        page.open(report.as_uri())
        assert 'alert("x")' in page.read("document.body.innerText")
        assert page.read("document.querySelectorAll('img').length") > 0
        assert not [text for text in browser.complaints if "favicon.ico" not in text]
