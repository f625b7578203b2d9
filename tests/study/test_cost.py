"""Hours by stored episodes, and bytes, of what a study lacks."""

from dataclasses import replace
from pathlib import Path

import pytest

from probe_kit.extract.needs import EPISODE, THUMBNAILS
from probe_kit.runs.layout import StoredStream
from probe_kit.study import load_study
from probe_kit.study.cells import Cell
from probe_kit.study.cost import Work, cost_of
from tests.study.broken_files import BASE

STREAMS = [StoredStream("backbone", 4, 64, None, 150, ("mean", "last"))]


@pytest.fixture
def cells(tmp_path: Path) -> dict[str, Cell]:
    file = tmp_path / "study.toml"
    file.write_text(BASE, encoding="utf-8")
    return {cell.name: cell for cell in load_study(file).cells}


def test_hours_come_from_stored_episodes_of_the_model_by_inferences(cells: dict[str, Cell]) -> None:
    plain, dark = cells["base/plain"], cells["base/dark"]
    short = replace(plain, settings=plain.settings.changed(scene=replace(plain.settings.scene, max_steps=20)))
    assert (plain.inferences / plain.episodes, short.inferences / short.episodes) == (40, 20)
    works = [Work(plain, 10, 90, 8.0, STREAMS), Work(replace(short, way="short"), 0, 36), Work(dark, 0, 0)]
    cost = cost_of(works)
    assert cost.seconds == {"base/plain": 720.0, "base/short": 144.0}
    assert cost.hours == {"base": pytest.approx(0.24)}
    assert (cost.unmeasured, cost.unsized) == ((), ())
    assert cost_of([Work(cells["reader/p1"], 0, 40)]).unmeasured == ("reader",)


def test_bytes_come_from_stored_streams_of_the_model(cells: dict[str, Cell]) -> None:
    plain, dark = cells["base/plain"], cells["base/dark"]
    activations = 2 * 4 * 64 * 2 * 4  # rows and columns, of layers, features, views and float32
    expected = activations + 4 * 16 + EPISODE + THUMBNAILS
    stored, new = Work(plain, 10, 3, 1.0, STREAMS), Work(dark, 0, 2)
    assert cost_of([stored, new]).bytes == {"base": 5 * expected}
    assert cost_of([new]).unsized == ("base",)


def test_every_inference_takes_bytes_at_most(cells: dict[str, Cell]) -> None:
    plain = cells["base/plain"]
    most, fixed = plain.settings.scene.max_steps, 4 * 16 + EPISODE + THUMBNAILS
    for later, bytes_of_later in (("all", 2 * 4 * 64 * 2 * 4), ("mean", 2 * 4 * 64 * 2)):
        every = replace(plain, settings=plain.settings.changed(captured_calls="all", later_views=later))
        expected = 2 * 4 * 64 * 2 * 4 + (most - 1) * bytes_of_later + fixed
        assert cost_of([Work(every, 10, 1, 1.0, STREAMS)]).bytes == {"base": expected}


def test_nothing_missing_takes_nothing(cells: dict[str, Cell]) -> None:
    cost = cost_of([Work(cells["base/plain"], 96, 0, 1.0, STREAMS)])
    assert cost.to_json() == {"hours": {}, "unmeasured": [], "bytes": {}, "unsized": []}
