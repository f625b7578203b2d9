"""The gates must stay shut on an honest suite, and open on one that leaks."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from probe_kit.statistics.folds import assign_folds
from probe_kit.suite import Item, Suite, build_suite, load_suite, validate_suite
from probe_kit.suite.validate import Baseline, limit_for, run_baselines


def part(suite: Suite, keep: Callable[[Item], bool]) -> Suite:
    """The same suite with some of its items only."""
    return replace(suite, items=tuple(item for item in suite.items if keep(item)))


@pytest.fixture(scope="module")
def honest(embedded: Suite) -> tuple[Baseline, ...]:
    return run_baselines(embedded)


@pytest.mark.slow
def test_every_embedded_category_is_within_its_limit(honest: tuple[Baseline, ...], embedded: Suite) -> None:
    assert {baseline.category for baseline in honest} == set(embedded.categories)
    assert {baseline.name for baseline in honest} == {"position", "instruction", "pixels", "statistics"}
    assert [str(baseline) for baseline in honest if not baseline.ok] == []


@pytest.mark.slow
def test_twins_put_every_baseline_at_exactly_one_half(honest: tuple[Baseline, ...]) -> None:
    assert {baseline.accuracy for baseline in honest} == {0.5}


@pytest.mark.slow
@pytest.mark.parametrize("category", ["attribute", pytest.param("state", marks=pytest.mark.slow)])
def test_pictures_give_the_answer_away_if_only_one_polarity_is_asked(category: str, tmp_path: Path) -> None:
    suite = build_suite(tmp_path / "suite", [category], 100)
    always_more = part(suite, lambda item: item.polarity == "pos")
    found = {baseline.name: baseline for baseline in run_baselines(always_more)}
    assert not found["statistics"].ok or (category == "state" and not found["pixels"].ok)


def test_text_gives_the_answer_away_if_a_layout_is_tied_to_it(embedded: Suite) -> None:
    """Both layouts protect the text; the position baseline cannot leave one half either."""
    tied = part(embedded.select(["state"]), lambda item: (item.polarity == "pos") == (item.correct_side == "left"))
    found = {b.name: b.accuracy for b in run_baselines(tied)}
    assert found["instruction"] == found["position"] == 0.5


def test_folds_never_separate_layouts_or_twins(embedded: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    from probe_kit.suite import validate as baselines

    made = []

    def spy(*arguments: Any) -> Any:
        made.append((arguments[1], assign_folds(*arguments)))
        return made[-1][1]

    monkeypatch.setattr(baselines, "assign_folds", spy)
    run_baselines(embedded.select(["time"]))
    ((groups, folds),) = made
    for group in set(groups):
        assert len(set(folds[groups == group])) == 1
    assert len(set(folds)) == 5


def test_the_limit_is_that_of_items_and_not_of_episodes() -> None:
    assert limit_for(150) == pytest.approx(0.580, abs=5e-4)
    assert limit_for(70) == pytest.approx(0.617, abs=5e-4)


def test_baselines_are_stored_in_the_suite_without_changing_it(copied: Path) -> None:
    before = load_suite(copied).identity
    report = validate_suite(copied, baselines=True)
    stored = json.loads((copied / "baselines.json").read_text(encoding="utf-8"))
    assert load_suite(copied).identity == before == stored["suite"]
    assert len(stored["baselines"]) == len(report.baselines or ()) == 8
    assert stored["sides"]["color"] == {"left": 6, "right": 6}
    assert all(uses["target"] == uses["distractor"] for uses in stored["roles"]["shape"].values())
    assert report.ok


def test_a_suite_with_errors_gets_no_baselines(copied: Path) -> None:
    load_suite(copied).items[0].picture("left").unlink()
    report = validate_suite(copied, baselines=True)
    assert not report.ok
    assert report.baselines is None
    assert not (copied / "baselines.json").exists()


def test_a_leak_is_a_warning_that_makes_the_report_not_ok(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leak = Baseline("color", "pixels", 0.71, (0.6, 0.8), 0.58, 150, 75, "group_id")
    monkeypatch.setattr("probe_kit.suite.validate.run_baselines", lambda *_: (leak,))
    report = validate_suite(copied, baselines=True)
    assert not report.ok
    assert "W05 Color: pixels 0.71 [0.60, 0.80] (limit 0.58)" in report.to_text()
