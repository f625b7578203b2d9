"""The report in a real browser, driven through the WebDriver protocol: no error, tables sort, filters filter."""

import json
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from probe_kit.extract.store.locations.locate import locate
from probe_kit.extract.store.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.retention.report import write_report
from probe_kit.train import ArrayRun

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--window-size=1400,1000",
)  # fmt: skip


class Browser:
    """A session of a browser that can open a page, run script in it and read its console."""

    def __init__(self, port: int, profile: Path) -> None:
        self._base = f"http://127.0.0.1:{port}"
        self._wait_until_ready()
        options = {"args": [*FLAGS, f"--user-data-dir={profile}"], "binary": shutil.which("chromium")}
        asked = {"browserName": "chrome", "goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}
        answer = self._call("POST", "/session", {"capabilities": {"alwaysMatch": asked}})
        self._session = f"/session/{answer['sessionId']}"

    def open(self, page: Path) -> None:
        self._call("POST", f"{self._session}/url", {"url": page.as_uri()})

    def run(self, script: str, *arguments: object) -> Any:
        return self._call("POST", f"{self._session}/execute/sync", {"script": script, "args": arguments})

    def console(self) -> list[Any]:
        return self._call("POST", f"{self._session}/se/log", {"type": "browser"})  # type: ignore[no-any-return]

    def resize(self, width: int) -> None:
        self._call("POST", f"{self._session}/window/rect", {"width": width, "height": 900})

    def quit(self) -> None:
        self._call("DELETE", self._session)

    def _wait_until_ready(self) -> None:
        for _ in range(300):
            try:
                self._call("GET", "/status")
            except OSError:
                time.sleep(0.05)
            else:
                return
        raise AssertionError("chromedriver did not answer within 15 s")

    def _call(self, method: str, path: str, content: object = None) -> Any:
        body = None if content is None else json.dumps(content).encode()
        request = urllib.request.Request(
            self._base + path, body, {"Content-Type": "application/json"}, method=method
        )
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)["value"]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixty episodes of two categories; every third is right, every second question has frames."""
    folder = tmp_path_factory.mktemp("report")
    outcomes = ["correct", "wrong", "oob"]
    rows = [
        {
            "episode": number,
            "episode_id": f"{number // 2}:{'os'[number % 2]}",
            "item_id": str(number // 2),
            "group_id": str(number // 2),
            "category": ("color", "living_world")[number >= 40],
            "layout": ("original", "swapped")[number % 2],
            "side_correct": ("left", "right")[number % 2],
            "outcome": outcomes[number % 3],
            "side_placed": ("left", "right", "none")[number % 3],
            "instruction": f"Put the cube on picture {number // 2}",
        }
        for number in range(60)
    ]
    frame = np.full((12, 16, 3), 200, np.uint8)
    for number in range(0, 60, 2):
        locate(folder).write(thumbnail_key(number), as_thumbnail((frame, 255 - frame)))
    run = ArrayRun(folder, "pi0", "suite@1#0123456789ab", pd.DataFrame(rows), {})
    return write_report([run], folder / "report.html")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    for program in ("chromium", "chromedriver"):
        if shutil.which(program) is None:
            pytest.skip(f"no {program} on this machine (Debian: apt install chromium chromium-driver)")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    driver = subprocess.Popen(["chromedriver", f"--port={port}"], stdout=subprocess.DEVNULL)
    try:
        session = Browser(port, tmp_path_factory.mktemp("profile"))
        yield session
        session.quit()
    finally:
        driver.terminate()
        driver.wait()


@pytest.fixture
def page(browser: Browser, report: Path) -> Browser:
    browser.open(report)
    return browser


def test_the_page_opens_without_a_word_on_the_console(page: Browser) -> None:
    assert page.run("return document.title") == "pi0 · probe_kit report"
    broken = "return [...document.images].filter(image => image.complete && !image.naturalWidth).length"
    assert page.run(broken) == 0
    fetched = "return performance.getEntriesByType('resource').map(entry => entry.name)"
    assert [name for name in page.run(fetched) if not name.startswith("data:")] == []
    assert page.console() == []


def test_a_click_on_a_heading_sorts_and_a_second_one_turns_it_round(page: Browser) -> None:
    column = """
        const table = document.querySelector("#behaviour table.sortable");
        const heading = [...table.tHead.rows[0].cells].find(cell => cell.textContent.trim() === arguments[0]);
        for (let click = 0; click < arguments[1]; click++) heading.firstElementChild.click();
        const read = row => row.cells[heading.cellIndex].dataset.sort;
        return [heading.getAttribute("aria-sort"), [...table.tBodies[0].rows].map(read), table.tFoot.rows.length];
    """
    assert page.run(column, "category", 2) == ["descending", ["living_world", "color"], 1]
    order, values, _ = page.run(column, "wrong\u00a0%", 1)
    assert order == "ascending"
    assert [float(value) for value in values] == sorted(float(value) for value in values)
    assert page.console() == []


@pytest.fixture
def comparison(browser: Browser, report: Path) -> Iterator[Browser]:
    """The report of two runs of long names; the window is as wide as before afterwards."""
    table = pd.concat([hits(), hits().assign(category="shape", item_id=lambda t: "s" + t["item_id"])])
    table["group_id"] = table["item_id"]
    table["episode_id"] = table["item_id"] + ":" + table["layout"].str[0]
    runs = []
    for name, outcome in (("a-policy-of-a-long-name", "correct"), ("another-policy-of-a-long-name", "wrong")):
        own = table.assign(outcome=[outcome, "oob", "correct", "wrong"] * (len(table) // 4))
        runs.append(ArrayRun(report.parent / name, name, "suite@1#0123456789ab", own.reset_index(drop=True), {}))
    browser.open(write_report(runs, report.parent / "two.html"))
    yield browser
    browser.resize(1400)


def hits() -> pd.DataFrame:
    """Twelve items of one category in both layouts."""
    return pd.DataFrame(
        {
            "item_id": str(number // 2),
            "category": "color",
            "layout": ("original", "swapped")[number % 2],
            "side_correct": ("left", "right")[number % 2],
            "side_placed": ("left", "right", "none")[number % 3],
        }
        for number in range(24)
    )


WIDE = """
    return [...document.querySelectorAll(".scroll")].filter(one => one.offsetParent).map(one => {
      const said = getComputedStyle(one.parentElement.querySelector(".cue")).display !== "none";
      const rest = one.scrollWidth - one.clientWidth;
      one.scrollLeft = rest;
      const last = one.querySelector("thead th:last-child").getBoundingClientRect();
      const first = one.querySelector("tbody td").getBoundingClientRect();
      const box = one.getBoundingClientRect();
      return [rest > 1, said, last.right <= box.right + 1, first.left >= box.left - 1];
    });
"""


@pytest.mark.parametrize("width", [1400, 400])
def test_a_column_beside_the_page_is_announced_and_can_be_reached(comparison: Browser, width: int) -> None:
    comparison.resize(width)
    across = "return [document.documentElement.scrollWidth, window.innerWidth]"
    page_width, window = comparison.run(across)
    assert page_width <= window, "the page itself never scrolls sideways"
    time.sleep(0.1)  # one frame, in which sizes are watched
    found = comparison.run(WIDE)
    assert found
    assert width == 1400 or any(wide for wide, *_ in found)
    for wide, said, reached, first_stays in found:
        assert said == wide
        assert reached
        assert first_stays
    assert comparison.console() == []


def test_sorting_keeps_differences_below_runs_and_a_third_click_undoes_it(comparison: Browser) -> None:
    script = """
        const table = document.querySelector("#behaviour table.sortable");
        const rows = () => [...table.tBodies[0].rows].map(row => row.className);
        const before = rows();
        const button = table.tHead.rows[0].cells[1].firstElementChild;
        const seen = [0, 1, 2].map(() => { button.click(); return rows(); });
        return [before, ...seen];
    """
    before, up, down, again = comparison.run(script)
    assert before == ["", "", "difference"] * 2
    assert up == down == [""] * 4 + ["difference"] * 2
    assert again == before


def test_the_title_names_every_run(comparison: Browser) -> None:
    title = comparison.run("return document.querySelector('h1').textContent")
    assert title == "a-policy-of-a-long-name and another-policy-of-a-long-name"


def test_filters_show_exactly_the_episodes_they_name(page: Browser) -> None:
    choose = """
        for (const [name, value] of Object.entries(arguments[0]))
          document.getElementById("filters").elements[name].value = value;
        document.getElementById("filters").dispatchEvent(new Event("input"));
        return [...document.querySelectorAll("#grid .card")].map(card => card.dataset.id);
    """
    assert len(page.run(choose, {})) == 48, "one page of cards"
    everything = {"category": "", "outcome": "", "layout": "", "words": ""}
    wanted = [f"{n // 2}:{'os'[n % 2]}" for n in range(60) if n % 3 == 0 and n % 2 == 1 and n < 40]
    picked = {"category": "color", "outcome": "correct", "layout": "swapped"}
    assert page.run(choose, everything | picked) == wanted
    assert page.run(choose, everything | {"words": "PICTURE 29"}) == ["29:o", "29:s"]
    assert page.run(choose, everything | {"category": "living_world", "words": "picture 3 "}) == []
    assert "0 match, 60 in all" in page.run("return document.getElementById('count').textContent")
    page.run(choose, everything)
    page.run("document.getElementById('more').click()")
    assert page.run("return document.querySelectorAll('#grid .card').length") == 60
    assert page.run("return document.getElementById('more').hidden")
    assert page.run("return document.querySelectorAll('#grid img').length") == 30
    assert page.console() == []
