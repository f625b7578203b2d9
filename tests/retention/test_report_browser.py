"""The report in a real browser: no error, tables sort, filters filter, sections fold, and nothing is cut off."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from probe_kit.retention.report import write_report
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.train import ArrayRun

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium (Debian: apt install chromium)"),
]
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--enable-logging=stderr",
    "--window-size=1500,1000", "--virtual-time-budget=4000",
)  # fmt: skip
READER = """<script>
window.addEventListener("load", async () => {{
  const read = async () => {{ {script} }};
  const answer = await read().catch(error => ({{ error: String(error) }}));
  window.parent.postMessage(JSON.stringify(answer), "*");
}});
</script>"""
FRAME = """<!doctype html><meta charset="utf-8"><pre id="found"></pre>
<script>
window.addEventListener("message", event => {{ document.getElementById("found").textContent = event.data; }});
</script>
<iframe style="border:0;width:{width}px;height:900px" src="{source}"></iframe>"""
"""A page in a frame of any width, and a place for what a script in it sends."""


def read(page: Path, script: str, width: int = 1400, dark: bool = False) -> Any:
    """What the script returns in the page, at a width of its own; the console must stay empty.

    A browser's own window cannot be narrow.
    """
    inner, outer = page.with_suffix(".read.html"), page.with_suffix(".frame.html")
    text, end, tail = page.read_text(encoding="utf-8").rpartition("</body>")
    inner.write_text(f"{text}{READER.format(script=script)}{end}{tail}", encoding="utf-8")
    outer.write_text(FRAME.format(width=width, source=inner.as_uri()), encoding="utf-8")
    scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    profile = f"--user-data-dir={page.parent / 'profile'}"
    completed = subprocess.run(
        ["chromium", *FLAGS, scheme, profile, "--dump-dom", outer.as_uri()],
        capture_output=True, encoding="utf-8", timeout=120, check=True,
    )  # fmt: skip
    assert [line for line in completed.stderr.splitlines() if "CONSOLE" in line] == []
    match = re.search(r'<pre id="found">(.+?)</pre>', completed.stdout, re.DOTALL)
    assert match, completed.stdout[-500:]
    answer = json.loads(html.unescape(match[1]))
    assert not (isinstance(answer, dict) and "error" in answer), answer
    return answer


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
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of two runs of long names."""
    folder = tmp_path_factory.mktemp("two")
    table = pd.concat([hits(), hits().assign(category="shape", item_id=lambda t: "s" + t["item_id"])])
    table["group_id"] = table["item_id"]
    table["episode_id"] = table["item_id"] + ":" + table["layout"].str[0]
    runs = []
    for name, outcome in (("a-policy-of-a-long-name", "correct"), ("another-policy-of-a-long-name", "wrong")):
        outcomes = table.assign(outcome=[outcome, "oob", "correct", "wrong"] * (len(table) // 4))
        runs.append(ArrayRun(folder / name, name, "suite@1#0123456789ab", outcomes.reset_index(drop=True), {}))
    return write_report(runs, folder / "two.html")


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


def test_the_page_opens_whole_and_fetches_nothing(report: Path) -> None:
    title, broken, fetched = read(
        report,
        """
        const images = [...document.images];
        return [document.title, images.filter(image => image.complete && !image.naturalWidth).length,
                window.performance.getEntriesByType("resource").map(entry => entry.name)];
        """,
    )
    assert title == "pi0 · probe_kit report"
    assert broken == 0
    assert [name for name in fetched if not name.startswith("data:")] == []


def test_a_click_on_the_arrows_of_a_heading_sorts_and_a_second_one_turns_it_round(report: Path) -> None:
    (order, categories, means), (upwards, values, _) = read(
        report,
        """
        const table = document.querySelector("#behaviour table.sortable");
        function sorted(name, clicks) {
          const heading = [...table.tHead.rows[0].cells].find(cell => cell.textContent.trim() === name);
          for (let click = 0; click < clicks; click++) heading.querySelector("button").click();
          const key = row => row.cells[heading.cellIndex].dataset.sort;
          return [heading.getAttribute("aria-sort"), [...table.tBodies[0].rows].map(key), table.tFoot.rows.length];
        }
        return [sorted("category", 2), sorted("wrong\u00a0%", 1)];
        """,
    )
    assert (order, categories, means) == ("descending", ["Living_world", "Color"], 1)
    assert upwards == "ascending"
    assert [float(value) for value in values] == sorted(float(value) for value in values)


WIDE = """
    for (const one of document.querySelectorAll("details")) one.open = true;
    await new Promise(done => setTimeout(done, 200));
    const boxes = [...document.querySelectorAll(".scroll")].filter(one => one.offsetParent).map(one => {
      const said = window.getComputedStyle(one.parentElement.querySelector(".cue")).display !== "none";
      const rest = one.scrollWidth - one.clientWidth;
      one.scrollLeft = rest;
      const cells = one.querySelector("tbody");
      const box = one.getBoundingClientRect();
      const last = (one.querySelector("thead th:last-child") ?? one.lastElementChild).getBoundingClientRect();
      const first = cells ? cells.querySelector("td").getBoundingClientRect() : box;
      return [rest > 1, said, last.right <= box.right + 1, first.left >= box.left - 1];
    });
    return [document.documentElement.scrollWidth, window.innerWidth, boxes];
"""


@pytest.mark.parametrize("width", [1400, 400])
@pytest.mark.parametrize("name", ["report", "comparison"])
def test_the_page_never_scrolls_sideways_and_what_is_wide_is_announced(
    request: pytest.FixtureRequest, name: str, width: int
) -> None:
    """With every section open; a table's last column can be reached, and its first one stays."""
    page_width, window, boxes = read(request.getfixturevalue(name), WIDE, width)
    assert page_width <= window == width
    assert boxes
    assert width == 1400 or any(wide for wide, *_ in boxes)
    for wide, announced, reached, first_stays in boxes:
        assert announced == wide
        assert reached
        assert first_stays


def test_sorting_keeps_differences_below_runs_and_a_third_click_undoes_it(comparison: Path) -> None:
    before, up, down, again = read(
        comparison,
        """
        const table = document.querySelector("#behaviour table.sortable");
        const rows = () => [...table.tBodies[0].rows].map(row => row.className);
        const before = rows();
        const button = table.tHead.rows[0].cells[1].querySelector("button");
        return [before, ...[0, 1, 2].map(() => { button.click(); return rows(); })];
        """,
    )
    assert before == ["", "", "difference"] * 2
    assert up == down == [""] * 4 + ["difference"] * 2
    assert again == before


def test_the_title_names_every_run(comparison: Path) -> None:
    title = read(comparison, "return document.querySelector('h1').textContent")
    assert title == "a-policy-of-a-long-name and another-policy-of-a-long-name"


def test_filters_show_exactly_the_episodes_they_name(report: Path) -> None:
    at_first, picked, words, none, count_text, *after_reset = read(
        report,
        """
        const form = document.getElementById("filters");
        function choose(values) {
          const all = { category: "", outcome: "", layout: "", words: "" };
          for (const [name, value] of Object.entries({ ...all, ...values }))
            form.elements[name].value = value;
          form.dispatchEvent(new window.Event("input"));
          return [...document.querySelectorAll("#grid .card")].map(card => card.dataset.id);
        }
        const found = [choose({}).length, choose({ category: "color", outcome: "correct", layout: "swapped" }),
          choose({ words: "PICTURE 29" }), choose({ category: "living_world", words: "picture 3 " }),
          document.getElementById("count").textContent];
        choose({});
        const more = document.getElementById("more");
        more.click();
        return [...found, document.querySelectorAll("#grid .card").length, more.hidden,
          document.querySelectorAll("#grid img").length];
        """,
    )
    assert at_first == 48, "one page of cards"
    assert picked == [f"{n // 2}:{'os'[n % 2]}" for n in range(60) if n % 3 == 0 and n % 2 == 1 and n < 40]
    assert words == ["29:o", "29:s"]
    assert none == []
    assert "0 match, 60 in all" in count_text
    assert after_reset == [60, True, 30]


def test_sections_are_folded_and_open_for_links_for_the_button_and_for_print(report: Path) -> None:
    folded, linked, printed, afterwards, unfolded = read(
        report,
        """
        const open = () => [...document.querySelectorAll("details")].filter(one => one.open).map(one => one.id);
        const folded = open();
        document.querySelector("#summary th a").click();
        await new Promise(done => setTimeout(done, 200));
        const linked = open();
        window.dispatchEvent(new window.Event("beforeprint"));
        const printed = [...document.querySelectorAll("details")].every(one => one.open);
        window.dispatchEvent(new window.Event("afterprint"));
        const afterwards = open();
        document.getElementById("unfold").click();
        const unfolded = [...document.querySelectorAll(".part")].every(one => one.open);
        return [folded, linked, printed, afterwards, unfolded];
        """,
    )
    assert folded == []
    assert linked == afterwards == ["words"]
    assert printed
    assert unfolded


def test_focused_elements_are_marked_and_the_first_link_skips_the_contents(report: Path) -> None:
    first, hidden, visible, outlines = read(
        report,
        """
        for (const one of document.querySelectorAll("details")) one.open = true;
        const reached = "a[href], button, summary, [tabindex='0'], select, input";
        const reachable = [...document.querySelectorAll(reached)];
        const skip = reachable[0];
        const hidden = skip.getBoundingClientRect().bottom;
        skip.focus({ focusVisible: true });
        const shown = skip.getBoundingClientRect().top;
        const outlines = reachable.filter(one => one.offsetParent).map(one => {
          one.focus({ focusVisible: true });
          return [one.outerHTML.slice(0, 80), window.getComputedStyle(one).outlineStyle];
        });
        return [skip.getAttribute("href"), hidden, shown, outlines];
        """,
    )
    assert first == "#summary"
    assert hidden < 0 <= visible
    assert len(outlines) > 10
    assert [name for name, style in outlines if style == "none"] == []


CONTRAST = """
    for (const one of document.querySelectorAll("details")) one.open = true;
    const parse = colour => colour.match(/[\\d.]+/g).map(Number);
    const linear = v => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4;
    const light = ([r, g, b]) => .2126 * linear(r / 255) + .7152 * linear(g / 255) + .0722 * linear(b / 255);
    function ground(one) {
      for (let up = one; up; up = up.parentElement) {
        const colour = parse(window.getComputedStyle(up).backgroundColor);
        if (colour.length === 3 || colour[3] === 1) return colour;
      }
      return [255, 255, 255];
    }
    const low = [];
    for (const one of document.querySelectorAll("body *")) {
      const own = [...one.childNodes].some(node => node.nodeType === 3 && node.textContent.trim());
      if (!own || !one.offsetParent || ["SCRIPT", "OPTION", "SELECT", "INPUT"].includes(one.tagName)) continue;
      const [a, b] = [light(parse(window.getComputedStyle(one).color)), light(ground(one))];
      const ratio = (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
      if (ratio < 4.5) low.push([one.outerHTML.slice(0, 90), ratio]);
    }
    return [window.getComputedStyle(document.body).backgroundColor, low];
"""


@pytest.mark.parametrize(("dark", "paper"), [(False, "rgb(255, 255, 255)"), (True, "rgb(20, 23, 26)")])
def test_every_word_can_be_read_in_both_colour_schemes(comparison: Path, dark: bool, paper: str) -> None:
    """The contrast that WCAG asks for of text (AA): 4.5."""
    background, low = read(comparison, CONTRAST, dark=dark)
    assert background == paper
    assert low == []
