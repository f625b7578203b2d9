"""The page as a parser reads it: what stands on the first screen, what is folded, and where links lead."""

import io
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from probe_kit._tables.table import Table
from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.columns.summary import HEADINGS
from probe_kit.retention.columns.tables import retention_tables
from probe_kit.retention.columns.text import VERDICT_HELP
from probe_kit.retention.compare.compare import Difference
from probe_kit.retention.report import report_html
from probe_kit.retention.report.episodes import episode_grid
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.train import ArrayRun
from tests.retention.asked_runs import acted, answer_run
from tests.retention.conftest import runs_in

SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7], [0.5, 0.65]])
NOISE = ([0.5, 0.52, 0.5], [[0.5, 0.5], [0.5, 0.51]])
VOID = {"img", "meta", "br", "input"}


@dataclass
class Element:
    """An element of a page. text: of itself and its children."""

    tag: str
    attributes: dict[str, str]
    parents: tuple["Element", ...]
    text: str = ""
    children: list["Element"] = field(default_factory=list)

    def inside(self, tag: str) -> list["Element"]:
        return [parent for parent in self.parents if parent.tag == tag]


class Page(HTMLParser):
    """All elements of a page in order. Raises AssertionError where an element is not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[Element] = []
        self._open: list[Element] = []
        self.feed(text)
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        element = Element(tag, {name: value or "" for name, value in attrs}, tuple(self._open))
        self.elements.append(element)
        if self._open:
            self._open[-1].children.append(element)
        if tag not in VOID:
            self._open.append(element)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop().tag == tag

    def handle_data(self, data: str) -> None:
        for element in self._open:
            element.text += data

    def all(self, tag: str) -> list[Element]:
        return [element for element in self.elements if element.tag == tag]

    def element_with_id(self, name: str) -> Element:
        (matching,) = [element for element in self.elements if element.attributes.get("id") == name]
        return matching


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Page:
    """Of a run with frames whose backbone holds Color and not Shape."""
    run = runs_in(tmp_path_factory.mktemp("runs"))({"shape": NOISE, "color": SIGNAL})
    for number in range(len(run.episodes)):
        frame = np.full((12, 16, 3), number % 250, np.uint8)
        locate(run.path).write(thumbnail_key(number), as_thumbnail((frame, frame)))
    return Page(report_html([run]))


def test_every_link_leads_somewhere_and_every_place_is_named_once(page: Page) -> None:
    places = [element.attributes["id"] for element in page.elements if "id" in element.attributes]
    assert len(places) == len(set(places))
    links = [element.attributes["href"] for element in page.all("a")]
    assert len(links) > 20
    assert [link for link in links if link.removeprefix("#") not in places] == []


def test_the_first_screen_is_question_summary_sentences_one_picture_and_one_curve(page: Page) -> None:
    before = page.elements[: page.elements.index(page.all("details")[0])]
    lead = next(element.text for element in before if element.attributes.get("class") == "lead")
    assert lead.startswith("What does it know")
    (table,) = [element for element in before if element.tag == "table"]
    assert "verdict" in table.text
    assert [
        element.text.partition(" ")[0] for element in before if element.tag == "li" and not element.inside("nav")
    ] == [
        "Shape",
        "Color",
    ]
    picture, curve = [element for element in before if element.tag == "img"]
    assert picture.attributes["src"].startswith("data:image/webp")
    assert curve.attributes["src"].startswith("data:image/svg+xml")
    assert "Color" in curve.attributes["alt"], "the category that has something to show"


def test_everything_else_is_folded_under_headings(page: Page) -> None:
    sections = [element for element in page.all("details") if element.attributes.get("class") == "part"]
    assert [element.attributes["id"] for element in sections][-4:] == ["episodes", "settings", "words", "cite"]
    for section in sections:
        assert "open" not in section.attributes
        summary = section.children[0]
        assert (summary.tag, [element.tag for element in summary.children]) == ("summary", ["h2"])
    main = [element for element in page.all("h2") if not element.inside("details")]
    assert [element.text for element in main] == ["Summary"]


def test_a_heading_and_a_verdict_lead_to_their_meaning(page: Page) -> None:
    headings = [element for element in page.all("th") if element.attributes.get("scope") == "col"]
    links = [link for element in headings for link in element.children[0].children if link.tag == "a"]
    assert len(links) > len(headings) / 2
    for link in links:
        entry = page.element_with_id(link.attributes["href"].removeprefix("#"))
        assert entry.tag == "dt"
        assert "".join(entry.text.split()) == "".join(link.text.split())
    (verdict,) = [
        element for element in page.all("a") if element.inside("td") and element.text == "shown, success not shown"
    ]
    target = page.element_with_id(verdict.attributes["href"].removeprefix("#"))
    siblings = target.parents[-1].children
    assert siblings[siblings.index(target) + 1].text == VERDICT_HELP["shown, success not shown"]


def test_keyboard_and_screen_readers_reach_everything(page: Page) -> None:
    body = page.all("body")[0]
    skip = body.children[0]
    assert (skip.tag, skip.attributes["href"]) == ("a", "#summary")
    assert "tabindex" in page.element_with_id("summary").attributes
    assert all(element.attributes["alt"] for element in page.all("img"))
    assert all(element.text.strip() or element.attributes.get("aria-label") for element in page.all("button"))
    assert all(element.inside("label") for element in page.elements if element.tag in ("select", "input"))
    scrolled = [element for element in page.elements if "scroll" in element.attributes.get("class", "").split()]
    assert scrolled
    assert all(element.attributes["tabindex"] == "0" and element.attributes["aria-label"] for element in scrolled)


def test_the_page_has_rules_for_the_dark_for_narrow_screens_and_for_print(page: Page) -> None:
    style = page.all("style")[0].text
    assert "@media screen and (prefers-color-scheme: dark)" in style, "paper is white, whatever the screen is"
    assert "@media print" in style
    assert "@media (max-width: 40rem)" in style
    (scheme,) = [element for element in page.all("meta") if element.attributes.get("name") == "color-scheme"]
    assert scheme.attributes["content"] == "light dark"


RIGHT = {"color": np.random.default_rng(0).random((20, 2)) < 0.85}


def test_a_model_that_only_answers_lacks_nothing_and_moves_no_cube(tmp_path: Path) -> None:
    run = answer_run(tmp_path, RIGHT)
    assert retention_table([run]).notes == ()
    page = Page(report_html([run]))
    assert [
        element.text for element in page.elements if element.attributes.get("class") in ("warning", "remark")
    ] == []
    page_text = "".join(element.text for element in page.all("main") if element).replace(
        page.all("script")[0].text, ""
    )
    assert "the VLM answers right in" in page_text
    assert "cube" not in "".join(
        element.text for element in page.elements if element.tag in ("li", "p", "dd", "figcaption", "th")
    )


def test_an_episode_of_both_kinds_of_model_shares_its_picture(tmp_path: Path) -> None:
    """The VLM's frame is the left half of the policy's picture, which stands in the page once."""
    vlm, policy = answer_run(tmp_path, RIGHT), acted(tmp_path, RIGHT)
    for number in range(len(policy.episodes)):
        first, last = (np.full((12, 16, 3), shade, np.uint8) for shade in (3 * number, 255))
        locate(vlm.path).write(thumbnail_key(number), as_thumbnail((first,)))
        locate(policy.path).write(thumbnail_key(number), as_thumbnail((first, last)))
    grid = episode_grid([vlm, policy], ["vlm", "policy"])
    count = len(policy.episodes)
    assert sum(map(len, grid.pictures)) == count
    for answer_card, action_card in zip(grid.cards[:count], grid.cards[count:], strict=True):
        assert (answer_card["frames"], answer_card["half"], action_card["frames"], action_card["half"]) == (
            1,
            True,
            2,
            False,
        )
        assert grid.picture(answer_card) == grid.picture(action_card)
    alone = episode_grid([vlm], ["vlm"])
    assert {(card["frames"], card["half"]) for card in alone.cards} == {(1, False)}


def test_equal_pictures_stand_in_the_page_once(tmp_path: Path) -> None:
    run = acted(tmp_path, RIGHT)
    frame = np.full((12, 16, 3), 7, np.uint8)
    for number in range(len(run.episodes)):
        locate(run.path).write(thumbnail_key(number), as_thumbnail((frame, frame)))
    grid = episode_grid([run], ["policy"])
    assert sum(map(len, grid.pictures)) == 1
    assert {card["picture"] for card in grid.cards} == {0}


ProbedRun = Callable[..., ArrayRun]
TIED = ([0.5, 0.9, 0.9], [[0.6, 0.8], [0.8, 0.8]])
FORMER = ("bounded [", "debiased", "area [", "unbounded")
"""Words of the three estimates that there were once."""


@pytest.fixture
def table(probed_run: ProbedRun) -> RetentionTable:
    runs = [probed_run({"color": TIED}, name) for name in ("one", "other")]
    return retention_table({"first": [runs[0]], "second": [runs[1]]})


def console(table: RetentionTable) -> str:
    screen = Console(width=240, file=io.StringIO())
    screen.print(table.to_rich("all"))
    return screen.file.getvalue()  # type: ignore[attr-defined,no-any-return]


def every_form(table: RetentionTable) -> dict[str, str]:
    """Text from the retention table on, by form; the one of a page is its headings and cells."""
    titled_table = retention_tables(table.all_rows, table.differences)["Retention"]
    return {
        "console": console(table).split("Retention, view")[1],
        "markdown": table.to_markdown().split("**Retention, view")[1],
        "latex": table.to_latex("all").split(r"\caption{Retention")[1],
        "page": text_of(titled_table),
    }


def text_of(table: Table) -> str:
    """What a page shows without its markup."""
    return unescape(re.sub(r"<style.*?</style>|<[^>]+>", " ", table._repr_html_())).replace("\u00a0", " ")


def test_every_table_leads_with_the_one_retention_and_the_published_ratio_beside_it(table: RetentionTable) -> None:
    row = table.rows[0].retention
    assert row.value is not None
    assert row.published is not None
    numbers = [f"{row.value:.2f}", f"{row.published:.2f}"]
    assert len(set(numbers)) == 2, "the two can be told apart"
    for form, text in every_form(table).items():
        lowered = text.lower()
        places = [lowered.find(name) for name in ("retention [95", "published ratio", "backbone")]
        assert -1 not in places, (form, places)
        assert places[0] < places[1], form
        assert -1 < text.find(numbers[0]) < text.find(numbers[1]), form
        assert not [name for name in FORMER if name in lowered], form


def test_every_table_names_the_call_the_first_iteration_and_ties(table: RetentionTable) -> None:
    for form, text in every_form(table).items():
        assert re.search(r"\bcall\b", text, re.IGNORECASE), form
        assert re.search(r"first it", text, re.IGNORECASE), form
        assert "80.0" in text.split("first it")[-1].lower(), form
        assert re.search(r"(?<![@\d])1 \+1\b", text), (form, "two layers of the backbone are as good")
        assert re.search(r"1 @0 \+2\b", text), (form, "three sites of the expert are as good")


def test_ties_stand_in_the_row(table: RetentionTable) -> None:
    row = table.rows[0]
    assert (row.backbone.ties, row.action.ties) == (1, 2)


def test_the_margin_that_decides_stands_before_the_papers(table: RetentionTable) -> None:
    row = table.rows[0]
    assert row.success.chance_margin_episodes is not None
    assert row.success.chance_margin is not None
    assert row.success.chance_margin_episodes < row.success.chance_margin
    deciding, papers = f"{100 * row.success.chance_margin:.1f}", f"{100 * row.success.chance_margin_episodes:.1f}"
    texts = {
        "console": console(table),
        "markdown": table.to_markdown(),
        "latex": table.to_latex("all"),
        "page": text_of(retention_tables(table.all_rows)["Success rate"]),
    }
    for form, text in texts.items():
        assert -1 < text.find(deciding) < text.find(papers), form


def test_the_summary_quotes_the_retention_of_the_mean(table: RetentionTable) -> None:
    rows = [row for row in table.all_rows if row.group == "first"]
    mean_retention = rows[-1].retention
    assert mean_retention.value is not None
    assert f"{mean_retention.value:.2f}" != f"{mean_retention.published:.2f}"
    first = next(run for run in table.summary if run.mean.row.group == "first")
    assert first.mean.cells[HEADINGS.index("retention")].text.startswith(f"{mean_retention.value:.2f} [")


def test_differences_hold_one_retention_and_the_call(table: RetentionTable) -> None:
    (row, mean) = table.differences
    assert isinstance(row, Difference)
    first, second = (color_row.retention.value for color_row in table.rows if color_row.category == "color")
    assert row.retention == pytest.approx(first - second)  # type: ignore[operator]
    assert row.retention_ci is not None
    assert (row.call, mean.call) == (0, 0)
    assert [name for name in vars(row) if "retention" in name] == [
        "retention", "retention_ci", "retention_models",
    ]  # fmt: skip
