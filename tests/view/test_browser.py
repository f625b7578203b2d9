"""The page in a real Chromium, from a file and from the server: it shows what the run holds."""

import json
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from probe_kit.intervene.stored import stored_interventions
from probe_kit.runs import Run, open_run
from probe_kit.runs.commits import write_failure
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import decode_frames, read_sheet, read_thumbnail
from probe_kit.suite import Suite
from probe_kit.train import load_results
from probe_kit.train.results.store import load_results_by_call
from probe_kit.view import write_viewer
from probe_kit.view.catalogue import Catalogue
from probe_kit.view.run_payloads import code_words, pack_log_odds, payload_script
from tests.support.browser import CHROMIUM, WHY_SKIPPED, Browser, Page
from tests.support.little_run import episode, little_plan, little_writer
from tests.view.conftest import (
    CALLS,
    FILM_STEPS,
    FILMED,
    HOSTILE,
    INFERENCES,
    LOST_WORDS,
    MISREAD,
    SHORTENED,
    TURNED,
)
from tests.view.payload_reader import log_odds, read_payload

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason=WHY_SKIPPED)]


@pytest.fixture(scope="module")
def index(runs: list[Run], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_viewer(runs, tmp_path_factory.mktemp("viewer") / "page")


@pytest.fixture(scope="module", params=["file", "server"])
def address(request: pytest.FixtureRequest, runs: list[Run], index: Path) -> Iterator[str]:
    if request.param == "file":
        yield index.as_uri()
        return
    with served(runs) as server:
        yield server


@contextmanager
def served(runs: list[Run], probes_of: Run | None = None) -> Iterator[str]:
    """The address that opens the page of a server."""
    pytest.importorskip("starlette", reason="the server of the viewer is not installed (starlette, uvicorn)")
    from probe_kit.view.server import ViewerServer

    server = ViewerServer(Catalogue(runs, probes_of))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield server.address
    finally:
        server.stop()
        thread.join(30)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    """A fresh page; its console stays empty."""
    browser.complaints.clear()
    yield browser.page()
    assert browser.complaints == []


def text(page: Page, selector: str) -> str:
    return str(page.read(f"document.querySelector({json.dumps(selector)}).innerText"))


def shown_count(page: Page) -> int:
    return int(text(page, "output.count").split(" of ")[0])


def cases(run: Run) -> list[int]:
    """Numbers of the episodes that the backbone's best site reads right, and that did not end correctly."""
    curve = load_results(run).curves["color", "mean"]
    right = curve.correct[curve.best("backbone")]
    wrong = dict(zip(run.episodes["episode_id"], run.episodes["outcome"] != "correct", strict=True))
    numbers = dict(zip(run.episodes["episode_id"], run.episodes["episode"], strict=True))
    return [int(numbers[name]) for name, read in zip(curve.episodes, right, strict=True) if read and wrong[name]]


def test_a_count_of_the_overview_opens_a_list_of_so_many_episodes(
    page: Page, address: str, runs: list[Run]
) -> None:
    assert load_results(runs[0]).scores.query("view == 'mean' and signal")["stream"].tolist() == ["backbone"]
    page.open(f"{address}#/overview")
    expected = cases(runs[0])
    assert text(page, "[data-count='backbone color']") == str(len(expected))
    page.click("[data-count='backbone color']")
    page.wait("document.querySelector('.episode')")
    assert shown_count(page) == len(expected)
    listed = page.read("[...document.querySelectorAll('.list .item small')].map(s => parseInt(s.textContent))")
    assert listed == expected


def test_a_site_without_signal_is_not_counted(page: Page, address: str) -> None:
    page.open(f"{address}#/overview")
    assert page.read("document.querySelector(\"[data-count='action color']\")") is None
    page.open(f"{address}#/map?site=expert.00.residual@0")
    assert page.read("document.querySelectorAll('.swarm').length") == 0
    assert "neither right nor wrong" in page.read("document.body.innerText")


def test_scrubbing_by_key_slider_and_drag_agree(page: Page, address: str, runs: list[Run]) -> None:
    page.open(f"{address}#/episodes?ep=0&t=0")
    last, toward_correct = runs[0].trajectory(0).steps, centimetres_toward_the_correct(runs[0], 0)

    def state() -> tuple[int, str, str, float]:
        step = int(page.read("document.querySelector('.scrub input').value"))
        assert value_at_cursor(page, "Arm") == signed(toward_correct[step])
        return (
            int(page.read("Number(new URLSearchParams(location.hash.split('?')[1]).get('t'))")),
            text(page, ".scrub output"),
            str(page.read("document.querySelector('.film').dataset.frame")),
            float(page.read("+document.querySelector('[data-series=Arm] .cursor').getAttribute('x1')")),
        )

    start = state()
    page.press("ArrowRight")
    by_key = state()
    assert by_key[:2] == (1, f"1 / {last}")
    page.press("End")
    by_end = state()
    page.press("Home")
    assert state() == start
    page.choose(".scrub input", str(last))
    assert state() == by_end == (last, f"{last} / {last}", "1", by_end[3])
    page.drag("[data-series=Arm] svg[role=img]", 0.0)
    assert state() == start
    page.drag("[data-series=Arm] svg[role=img]", 0.99)
    assert state() == by_end
    assert by_end[3] > by_key[3] > start[3]


def centimetres_toward_the_correct(run: Run, number: int) -> np.ndarray:
    """(T + 1,) how far the tool is from the middle between the pictures, along the line to the correct one."""
    path, side = run.trajectory(number), run.episodes["side_correct"].iloc[number]
    left, right = (tile[0, :2].astype(float) for tile in (path.tile_left, path.tile_right))
    correct, other = (left, right) if side == "left" else (right, left)
    unit = (correct - other) / np.linalg.norm(correct - other)
    return 100 * (path.tool[:, :2].astype(float) - (correct + other) / 2) @ unit


def value_at_cursor(page: Page, series: str, key: int = 1) -> str:
    """What the heading of a chart says of its line number `key` at the cursor."""
    return text(page, f"[data-series={series}] .key:nth-child({key}) output")


def signed(value: float) -> str:
    return f"{value:+.1f}".replace("-", "−")


def test_log_odds_hold_until_the_next_inference_and_are_those_of_both_probes(
    page: Page, address: str, runs: list[Run]
) -> None:
    position = runs[0].episodes["episode"].tolist().index(FILMED)
    toward = 1 if runs[0].episodes["side_correct"].iloc[position] == "left" else -1
    stored = []
    for call, results in load_results_by_call(runs[0], load_results(runs[0])).items():
        curve = results.curves["color", "mean"]
        if call == 0:
            site = curve.best("backbone")
        at = curve.episodes.tolist().index(runs[0].episodes["episode_id"].iloc[position])
        stored.append(toward * curve.decisions[site, at])
    for step in range(FILM_STEPS):
        page.open(f"{address}#/episodes?ep={FILMED}&t={step}")
        call = sum(start <= step for start in INFERENCES) - 1
        frozen, refitted = value_at_cursor(page, "Probe"), value_at_cursor(page, "Probe", 2)
        if call == CALLS:
            assert frozen == refitted == "–"
            continue
        assert float(refitted.replace("−", "-")) == pytest.approx(stored[call], abs=0.053)
        assert frozen == refitted if call == 0 else frozen != "–"
    names = page.read("[...document.querySelectorAll('[data-series=Probe] .key')].map(key => key.innerText)")
    assert [name.partition(", ")[2].split("\n")[0].strip(" –") for name in names[:2]] == [
        "probe of inference 0", "refitted",
    ]  # fmt: skip


def test_the_frame_that_is_shown_is_the_stored_one(page: Page, address: str, runs: list[Run]) -> None:
    stored = read_thumbnail(runs[0].location, 1)
    assert stored is not None
    both = np.asarray(Image.open(BytesIO(stored)).convert("RGB"), int)
    width = both.shape[1] // 2
    for step, half in ((0, both[:, :width]), (runs[0].trajectory(1).steps, both[:, width:])):
        page.open(f"{address}#/episodes?ep=1&t={step}")
        page.read("document.querySelector('.stamp').remove()")
        page.read("new Promise(done => setTimeout(done, 300))")
        picture = picture_of(page, ".film")
        middle = picture[len(picture) // 4 : -len(picture) // 4, 40:-40].reshape(-1, 3)
        assert np.abs(np.median(middle, axis=0) - np.median(half.reshape(-1, 3), axis=0)).max() <= 3


def test_the_film_shows_every_stored_frame_at_its_step(page: Page, address: str, runs: list[Run]) -> None:
    sheet = read_sheet(runs[0].location, FILMED)
    assert sheet is not None
    assert sheet.count == FILM_STEPS + 1
    page.open(f"{address}#/episodes?ep={FILMED}&t=0")
    page.read("new Promise(done => setTimeout(done, 300))")
    for step, frame in enumerate(decode_frames(sheet.content, sheet.count)):
        assert text(page, ".scrub output") == f"{step} / {FILM_STEPS}"
        picture = picture_of(page, ".film")
        for half in (slice(0, 0.5), slice(0.5, 1)):
            assert np.abs(median_of(picture, half) - median_of(frame, half)).max() <= 3, step
        page.press("ArrowRight")
    assert page.read("document.querySelector('.stamp')") is None


def picture_of(page: Page, selector: str) -> np.ndarray:
    """The pixels of an element, (H, W, 3)."""
    box = page.read(
        f"(() => {{ const b = document.querySelector({json.dumps(selector)}).getBoundingClientRect(); "
        "return [b.left, b.top, b.right, b.bottom].map(Math.round); })()"
    )
    return np.asarray(Image.open(BytesIO(page.picture(full_page=False))).convert("RGB").crop(box), int)


def median_of(pixels: np.ndarray, share: slice) -> np.ndarray:
    """Median colour of a part of the width, without its edges."""
    height, width = pixels.shape[:2]
    start, stop = (int(width * (edge + shift)) for edge, shift in ((share.start, 0.05), (share.stop, -0.05)))
    return np.median(pixels[height // 8 : -height // 8, start:stop].reshape(-1, 3), axis=0)


def test_every_cell_of_a_map_shows_its_stored_scores(page: Page, address: str, runs: list[Run]) -> None:
    page.open(f"{address}#/map?category=color")
    results = load_results(runs[0])
    curve, scores = results.curves["color", "mean"], results.scores.query("view == 'mean'")
    permuted = {str(site): np.quantile(curve.null[site_row], 0.95) for site_row, site in enumerate(curve.sites)}
    for row in scores.to_dict("records"):
        page.hover(f".mapwrap [data-site='{row['site']}']")
        read = text(page, "dl.readout")
        share, low, high = (f"{100 * row[name]:.1f}" for name in ("accuracy", "ci_low", "ci_high"))
        assert f"{share} [{low}, {high}]" in read
        assert f"{row['p']:.3f}" in read
        assert f"{row['p_fwe']:.3f}" in read
        assert f"{100 * permuted[row['site']]:.1f}" in read
        assert ("no signal shown" in read) == (not row["signal"])


def test_from_a_cell_to_an_episode_and_back_is_the_same_place(page: Page, address: str) -> None:
    page.open(f"{address}#/map?category=color")
    page.click(".mapwrap [data-site='backbone.01.residual']")
    page.wait("document.querySelector('.chip')")
    before, number = page.read("[location.hash, document.querySelector('.chip').textContent]")
    page.click(".chip")
    page.wait("document.querySelector('.episode')")
    assert f"episode {number}" in text(page, ".facts")
    page.read("history.back()")
    page.wait("document.querySelector('.mapwrap')")
    assert page.read("location.hash") == before


def test_an_address_shows_the_same_in_a_fresh_browser(browser: Browser, page: Page, address: str) -> None:
    page.open(f"{address}#/episodes?category=color&layout=swapped")
    page.press("j")
    page.press("ArrowRight")
    fragment, read = page.read("location.hash"), text(page, "main")
    other = browser.page()
    other.open(address + fragment)
    assert text(other, "main") == read


def test_filters_work_together_down_to_none_and_back(page: Page, address: str, runs: list[Run]) -> None:
    page.open(f"{address}#/episodes")
    episodes = runs[0].episodes
    page.choose("select[name=layout]", "swapped")
    page.choose("select[name=outcome]", "wrong")
    matching = episodes.query("layout == 'swapped' and outcome == 'wrong'")
    assert shown_count(page) == len(matching)
    page.choose("input[name=words]", "no such words")
    assert shown_count(page) == 0
    page.click(".empty a")
    assert shown_count(page) == len(episodes)
    page.read("history.back()")
    page.wait("document.querySelector('output.count').innerText.startsWith('0 ')")


def test_two_runs_are_compared_by_pair_and_step(page: Page, address: str, runs: list[Run]) -> None:
    page.open(f"{address}#/compare")
    a, b = (run.episodes["outcome"].eq("correct").tolist() for run in runs)
    for name, of_a, of_b in (("right-wrong", True, False), ("wrong-right", False, True)):
        matching_pairs = [n for n, pair in enumerate(zip(a, b, strict=True)) if pair == (of_a, of_b)]
        assert text(page, f"[data-quad={name}] b") == str(len(matching_pairs))
    number = int(page.read("document.querySelector('[data-quad=right-wrong] .chip').textContent"))
    page.click("[data-quad=right-wrong] .chip")
    tools = [run.trajectory(number).tool[:, :3].astype(float) for run in runs]
    apart = np.linalg.norm(tools[0] - tools[1], axis=1)
    assert f"the tools part by 5 mm at step {np.flatnonzero(apart > 0.005)[0]}" in text(page, ".sentence")


def test_a_question_shows_both_layouts_with_what_the_probes_read_and_the_arm_did(
    page: Page, address: str, runs: list[Run]
) -> None:
    page.open(f"{address}#/questions")
    curve, episodes = load_results(runs[0]).curves["color", "mean"], runs[0].episodes
    read = dict(zip(curve.episodes, curve.correct[curve.best("backbone")], strict=True))
    assert page.read("document.querySelectorAll('tbody tr').length") == episodes["item_id"].nunique()
    disagreeing, responses = [], responses_of(runs[0])
    for row in episodes.to_dict("records"):
        cell = f"[data-item='{row['item_id']}'] [data-stage='{{}} {row['layout']}']"
        right = row["outcome"] == "correct"
        assert text(page, cell.format("arm")).startswith("✓" if right else "✗")
        assert text(page, cell.format("backbone")).startswith("✓" if read[row["episode_id"]] else "✗")
        assert text(page, cell.format("action")) == "–"
        assert text(page, cell.format("swap")) == responses[row["episode_id"]]
        if bool(read[row["episode_id"]]) != right:
            disagreeing.append(row["item_id"])
    first = page.read("document.querySelector('tbody tr').dataset.item")
    assert disagreeing.count(first) == max(map(disagreeing.count, disagreeing))


def responses_of(run: Run) -> dict[str, str]:
    """What the page says of the action of every episode once the pictures are swapped."""
    (stored,) = stored_interventions(run, "image-swap")
    outcomes, responses = stored.outcomes, {}
    for number, name in enumerate(outcomes.episodes):
        toward = 1 if outcomes.sides[number] == "left" else -1
        clean, swapped = toward * outcomes.displacement[:, number] > 0
        responses[str(name)] = "does not" if clean == swapped else "✓ follows" if clean else "✗ reverses"
    return responses


def test_runs_differ_in_log_odds_only_where_both_have_signal(page: Page, address: str, runs: list[Run]) -> None:
    curves = [load_results(run).curves["color", "mean"] for run in runs]
    assert [results.scores.query("view == 'mean' and signal")["stream"].unique().tolist()
            for results in map(load_results, runs)] == [["backbone"]] * 2  # fmt: skip
    signs = []
    for run, curve in zip(runs, curves, strict=True):
        of = dict(zip(curve.episodes.tolist(), curve.decisions[curve.best("backbone")] > 0, strict=True))
        signs.append([of[name] for name in run.episodes["episode_id"]])
    differ = [first_sign != other for first_sign, other in zip(*signs, strict=True)]
    assert differ[MISREAD[1]]
    for number in (0, FILMED, MISREAD[1]):
        page.open(f"{address}#/compare?ep={number}")
        is_announced = "the log-odds differ in sign at inference 0, step 0" in text(page, ".sentence")
        assert is_announced == differ[number], number
        assert text(page, "[data-series=Probe] .key").startswith("A backbone.")
    page.open(f"{address}#/compare?ep={MISREAD[1]}&site=expert.00.residual@0")
    assert "log-odds" not in text(page, ".sentence")
    assert "No log-odds are compared" in text(page, ".compare")


def test_hostile_text_is_text(page: Page, address: str) -> None:
    for view in ("overview?run=b", "episodes?ep=0", "questions", "compare?ep=0", "map"):
        page.open(f"{address}#/{view}")
        run_name = page.read("document.querySelector('.run').textContent")
        assert HOSTILE in run_name
        page_source = page.read("document.documentElement.outerHTML")
        assert page.read("document.querySelectorAll('img, #app script').length") == 0
        assert TURNED[0] not in page_source, view
    page.open(f"{address}#/episodes?ep=0")
    assert text(page, ".episode h2") == f"“Put the cube on {HOSTILE} {TURNED.replace(TURNED[0], '\ufffd')}”"
    assert page.read("document.querySelector('.plan .what').textContent + document.title").count("<img") <= 2
    page.open(f"{address}#/questions")
    assert HOSTILE in text(page, "tbody")


@pytest.mark.parametrize(
    "fragment",
    [
        "#/nothing", "#/episodes?ep=abc&t=-7&case=x&category=none&site=no", "#/map?category=%00&site=1", "#?&&=",
        "#/compare?with=none&ep=999", "#/episodes?t=1e9&case=constructor.right-wrong", "#/constructor",
        "#/episodes?outcome=lost&layout=none&case=backbone.constructor", "#/questions?category=none&from=-3",
    ],
)  # fmt: skip
def test_an_unknown_address_falls_back(page: Page, address: str, fragment: str) -> None:
    page.open(address + fragment)
    assert page.read("document.querySelector('main').innerText.length") > 40
    assert page.read("document.querySelectorAll('.trouble').length") == 0
    assert page.read("document.querySelectorAll('main .empty').length") == 0, "filters that read “all” keep all"
    if "questions" in fragment:
        assert page.read("document.querySelectorAll('[data-item]').length") > 0


def test_the_page_can_be_used_by_keyboard_alone(page: Page, address: str) -> None:
    page.open(f"{address}#/map")
    page.read("document.querySelector('.mapwrap [tabindex=\"0\"]').focus()")
    before = page.read("document.activeElement.dataset.site")
    page.press("ArrowRight")
    page.press("ArrowLeft")
    page.press("ArrowDown")
    after = page.read("document.activeElement.dataset.site")
    assert after != before
    page.press("Enter")
    assert page.read("new URLSearchParams(location.hash.split('?')[1]).get('site')") == after
    page.press("Tab")
    outlines = []
    for _ in range(12):
        page.press("Tab")
        outlines.append(page.read(FOCUS))
    assert [focused for style, focused in outlines if style == "none" and "<body" not in focused] == []
    page.read("document.activeElement.blur()")
    page.press("3")
    page.wait("location.hash.startsWith('#/episodes')")
    page.press("/")
    assert page.read("document.activeElement.name") == "words"


CATEGORIES, LAYERS, ITERATIONS, EPISODES = 11, 19, 10, 3440
"""As many as the benchmark has, and sites as pi0 has them."""


def repeated(payload: dict[str, Any]) -> dict[str, Any]:
    """The payload of all episodes as that of as many as the benchmark has, two of an item."""
    rows, longer = [number % len(payload["id"]) for number in range(EPISODES)], dict(payload)
    for name, column in payload.items():
        if isinstance(column, list):
            longer[name] = [column[row] for row in rows]
        elif "codes" in column:
            longer[name] = {**column, "codes": [column["codes"][row] for row in rows]}
    packed = payload["log_odds"].items()
    longer["log_odds"] = {part: pack_log_odds(log_odds(values)[rows]) for part, values in packed}
    longer["number"], longer["id"] = list(range(EPISODES)), [f"episode {number}" for number in range(EPISODES)]
    longer["item"] = code_words([f"item {number // 2}" for number in range(EPISODES)])
    longer["layout"] = code_words(["original", "swapped"] * (EPISODES // 2))
    longer["category"] = code_words([f"c{number // 2 % CATEGORIES}" for number in range(EPISODES)])
    return longer


@pytest.fixture
def crowded(index: Path, tmp_path: Path) -> str:
    """The page with 3,440 episodes of eleven categories, and 209 sites whose accuracy says which one it is."""
    folder = tmp_path / "page"
    shutil.copytree(index.parent, folder)
    data = folder / "data" / "a"
    run, color_map = (read_payload((data / f"{name}.js").read_bytes())[1] for name in ("run", "map/color"))
    sites = [("backbone", layer, None) for layer in range(LAYERS)]
    sites += [("expert", layer, step) for step in range(ITERATIONS) for layer in range(LAYERS)]
    run["sites"] = [
        {"name": f"{stream}.{layer:02d}.residual" + ("" if step is None else f"@{step}"), "stream": stream,
         "layer": layer, "iteration": step}
        for stream, layer, step in sites
    ]  # fmt: skip
    run["categories"] = [{**run["categories"][0], "name": f"c{n}", "title": f"C{n}"} for n in range(CATEGORIES)]
    color_map["accuracy"] = [round(0.5 + row / 500, 4) for row in range(len(sites))]
    color_map["signal"] = [row % 7 == 0 for row in range(len(sites))]
    color_map["cells"] = [[f"cell {row}", *color_map["cells"][0][1:]] for row in range(len(sites))]
    color_map["log_odds"] = pack_log_odds(np.zeros((len(sites), len(color_map["rows"]))))
    for key in ("a", "b"):
        episodes_payload = read_payload((folder / "data" / key / "episodes.js").read_bytes())[1]
        (folder / "data" / key / "episodes.js").write_bytes(
            payload_script(f"{key}/episodes", repeated(episodes_payload))
        )
    script = (data / "e" / "00000.js").read_bytes()
    for number in range(len(episodes_payload["id"]), EPISODES):
        (data / "e" / f"{number:05d}.js").write_bytes(
            script.replace(b"a/e/00000", f"a/e/{number:05d}".encode(), 1)
        )
        (data / "f" / f"{number:05d}.webp").hardlink_to(data / "f" / "00000.webp")
    (data / "run.js").write_bytes(payload_script("a/run", run))
    for category in run["categories"]:
        (data / "map" / f"{category['name']}.js").write_bytes(
            payload_script(f"a/map/{category['name']}", color_map)
        )
    return (folder / "index.html").as_uri()


def test_maps_of_all_categories_are_few_elements_and_every_site_can_be_reached(page: Page, crowded: str) -> None:
    page.open(f"{crowded}#/map?category=c1&site=expert.00.residual@0")
    page.settle()
    assert page.read("document.querySelectorAll('.smallmap').length") == CATEGORIES
    assert page.read("document.querySelectorAll('*').length") <= 2000
    page.read("document.querySelectorAll('.smallmap')[3].focus()")
    for key, site in (("ArrowUp", 20), ("ArrowRight", 39), ("ArrowDown", 38), ("ArrowLeft", 19), ("ArrowLeft", 0)):
        page.press(key)
        announcement = text(page, "figure:nth-child(4) .smallmap [aria-live]")
        assert announcement == page.read("document.activeElement.title")
        assert announcement.endswith(f": cell {site}"), (key, announcement)
    page.press("Enter")
    assert "category=c3" in page.read("location.hash")
    assert "site=backbone.00.residual" in page.read("location.hash")
    for column, row, site in ((0, 0, 18), (3, LAYERS - 1, 19 + 2 * LAYERS), (10, 0, 18 + 10 * LAYERS)):
        page.hover_at("figure:nth-child(6) .smallmap", *spot(column, row))
        assert str(page.read("document.querySelectorAll('.smallmap')[5].title")).endswith(f": cell {site}")


def test_every_view_of_the_benchmarks_episodes_is_few_elements_and_every_item_can_be_reached(
    page: Page, crowded: str
) -> None:
    for view in ("overview", "map", "episodes?ep=1", "compare?with=b&ep=1", "questions"):
        page.open(f"{crowded}#/{view}")
        page.settle()
        assert 100 < page.read("document.querySelectorAll('*').length") <= 2000, view
    listed = "[...document.querySelectorAll('[data-item]')].map(row => row.dataset.item)"
    items = page.read(listed)
    assert text(page, ".questions .note").startswith("Items 1 to 60 of 1,720")
    while page.read("[...document.querySelectorAll('.note a')].some(one => one.innerText === 'next')"):
        page.click(".note a:last-of-type")
        items += page.read(listed)
    assert len(items) == len(set(items)) == EPISODES // 2
    page.click(".note a")
    assert text(page, ".questions .note").startswith("Items 1,621 to 1,680")
    page.open(f"{crowded}#/questions?from=99999&category=c3")
    assert text(page, ".questions .note").startswith("Items 121 to 157 of 157")


def spot(column: int, row: int) -> tuple[float, float]:
    """Shares of width and height of the middle of a cell: the streams are 0.6 cells apart."""
    return (column + 0.5 + 0.6 * (column > 0)) / (ITERATIONS + 1.6), (row + 0.5) / LAYERS


def test_words_that_did_not_reach_the_model_are_struck_out(page: Page, address: str, runs: list[Run]) -> None:
    words = str(runs[0].episodes["instruction"].iloc[SHORTENED]).split()
    page.open(f"{address}#/episodes?ep={SHORTENED}")
    assert text(page, ".episode h2 del") == " ".join(words[-LOST_WORDS:])
    assert text(page, ".episode h2") == f"“{' '.join(words)}”"
    assert f"{LOST_WORDS} words did not reach the model" in text(page, ".facts")
    page.open(f"{address}#/episodes?ep=0")
    assert page.read("document.querySelector('del')") is None


FOCUS = "[getComputedStyle(document.activeElement).outlineStyle, document.activeElement.outerHTML.slice(0, 120)]"
WIDE = """[...document.querySelectorAll("main *")].filter(one => !one.closest(".scroll, svg") &&
    one.getBoundingClientRect().right > innerWidth + 1).map(one => one.outerHTML.slice(0, 160))"""
HIDDEN_VIEWS = """
    [...document.querySelectorAll("nav[aria-label=Views] a")].filter(one => {
    const box = one.getBoundingClientRect(), nav = one.parentElement.getBoundingClientRect();
    return box.left < nav.left - 1 || box.right > nav.right + 1 || nav.right > innerWidth;
    }).map(one => one.innerText)"""

CONTRAST = """(() => {
    const canvas = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
    const parse = colour => { canvas.clearRect(0, 0, 1, 1); canvas.fillStyle = colour; canvas.fillRect(0, 0, 1, 1);
      return [...canvas.getImageData(0, 0, 1, 1).data]; };
    const linear = v => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4;
    const light = ([r, g, b]) => .2126 * linear(r / 255) + .7152 * linear(g / 255) + .0722 * linear(b / 255);
    const ground = one => { for (let up = one; up; up = up.parentElement) {
      const colour = parse(getComputedStyle(up).backgroundColor); if (colour[3] === 255) return colour; }
      return [255, 255, 255]; };
    const low = [];
    for (const one of document.querySelectorAll("body *")) {
      const own = [...one.childNodes].some(node => node.nodeType === 3 && node.textContent.trim());
      if (!own || !one.checkVisibility() || one.closest(".sr, option, .film, [aria-hidden=true]")) continue;
      const style = getComputedStyle(one);
      const [a, b] = [light(parse(one.closest("svg") ? style.fill : style.color)), light(ground(one))];
      const ratio = (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
      if (ratio < 4.5) low.push([one.outerHTML.slice(0, 110), ratio]);
    }
    return low;
})()"""


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [1400, 400])
def test_nothing_overflows_and_every_word_can_be_read(
    browser: Browser, address: str, width: int, dark: bool
) -> None:
    browser.complaints.clear()
    page = browser.page(width, dark=dark)
    for view in ("overview", "map", "episodes?ep=1", "compare", "questions", "results"):
        page.open(f"{address}#/{view}")
        page.settle()
        assert page.read("document.documentElement.scrollWidth") <= width, (view, page.read(WIDE))
        assert page.read(CONTRAST) == [], view
        assert page.read(HIDDEN_VIEWS) == [], view
    assert browser.complaints == []


def test_a_damaged_payload_is_named(browser: Browser, runs: list[Run], tmp_path: Path) -> None:
    page_file = write_viewer(runs[:1], tmp_path / "page")
    shutil.rmtree(page_file.parent / "data" / "a" / "e")
    page = browser.page()
    page.open(f"{page_file.as_uri()}#/episodes?ep=3")
    assert "data/a/e/00003.js is missing" in text(page, ".trouble")
    (page_file.parent / "data" / "index.js").write_text('put("index",{"schema":99,"runs":[]})', encoding="utf-8")
    page.open("about:blank")
    page.open(page_file.as_uri())
    assert "schema 99" in text(page, ".trouble")
    browser.complaints.clear()


def test_a_served_page_shows_episodes_that_are_committed_while_it_is_open(
    browser: Browser, small_suite: Suite, little_runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("starlette", reason="the server of the viewer is not installed (starlette, uvicorn)")
    monkeypatch.setattr("probe_kit.view.server.TICK_S", 0.05)
    browser.complaints.clear()
    plan = little_plan(small_suite.select(["color"]), 0, 6)
    writer = little_writer(locate(tmp_path / "run"), plan)
    for number in range(3):
        writer.write(episode(plan, number))
    with served([open_run(tmp_path / "run", allow_partial=True)], open_run(little_runs / "run")) as opened:
        page = browser.page()
        page.open(opened)
        assert page.read("location.search") == ""
        assert text(page, ".live") == "3 of 6 episodes so far"
        page.open(f"{opened.partition('?')[0]}#/episodes?layout=original&ep=2&t=1")
        page.wait("document.querySelector('.episode .sitemap')")
        before = [text(page, selector) for selector in ("h2", ".scrub output", "output.count")]
        page.wait("document.querySelector('[role=status]').textContent.startsWith('3 of 6')")
        page.read(
            "window.spoken = []; new MutationObserver(found => window.spoken.push(...found)).observe("
            "document.querySelector('[role=status]'), {characterData: true, childList: true, subtree: true})"
        )
        began = time.monotonic()
        assert before[2] == "2 of 3"
        for number in (3, 4):
            writer.write(episode(plan, number))
        page.wait("document.querySelector('.live').innerText.startsWith('5 of 6')")
        page.wait("document.querySelector('output.count').innerText === '3 of 5'")
        assert text(page, ".run option").endswith("(run, 5)")
        after = [text(page, selector) for selector in ("h2", ".scrub output")]
        assert after == before[:2]
        assert page.read("document.querySelectorAll('.episode .sitemap, [data-series=Probe]').length") == 2
        write_failure(open_run(tmp_path / "run", allow_partial=True).root, 5, "the arm broke", "")
        page.wait("document.querySelector('.live').innerText.endsWith(', 1 failed')")
        seconds = time.monotonic() - began
        assert page.read("window.spoken.length") <= 1 + seconds // 10, "a screen reader is told rarely"
        assert page.read("document.querySelector('.list [aria-selected=true] small').textContent").startswith("2 ")
        page.open("about:blank")
    assert browser.complaints == []
