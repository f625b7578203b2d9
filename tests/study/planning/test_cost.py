"""Hours with their source, and bytes, of what a study lacks."""

from dataclasses import replace
from pathlib import Path

import pytest

from probe_kit.extract.needs import EPISODE, THUMBNAILS
from probe_kit.runs.layout import StoredStream
from probe_kit.study import Ledger, load_study
from probe_kit.study.cells import Cell
from probe_kit.study.ledger import Speed
from probe_kit.study.planning.cost import Work, cost_of
from tests.study.broken_files import BASE

STREAMS = [StoredStream("backbone", 4, 64, None, 150, ("mean", "last"))]
SPEED = Speed(seconds=0.25, bytes=1000, batch=1, device="cpu", tokens="pooled", episodes=8)


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    return Ledger(str(tmp_path / "out"))


@pytest.fixture
def cells(tmp_path: Path) -> dict[str, Cell]:
    file = tmp_path / "study.toml"
    file.write_text(BASE, encoding="utf-8")
    return {cell.name: cell for cell in load_study(file).cells}


def test_hours_come_from_stored_episodes_of_the_model_by_inferences(
    cells: dict[str, Cell], ledger: Ledger
) -> None:
    plain, dark = cells["base/plain"], cells["base/dark"]
    short = replace(plain, settings=plain.settings.changed(scene=replace(plain.settings.scene, max_steps=20)))
    assert (plain.inferences / plain.episodes, short.inferences / short.episodes) == (40, 20)
    works = [Work(plain, 10, 90, 8.0, STREAMS), Work(replace(short, way="short"), 0, 36), Work(dark, 0, 0)]
    cost = cost_of(works, ledger)
    assert cost.seconds == {"base/plain": 720.0, "base/short": 144.0}
    assert cost.hours == {"base": pytest.approx(0.24)}
    assert cost.sources == {"base": "stored episodes"}
    assert (cost.unmeasured, cost.unsized) == ((), ())


def test_a_calibrated_rate_holds_for_its_batch_and_device(cells: dict[str, Cell], ledger: Ledger) -> None:
    plain, reader = cells["base/plain"], cells["reader/p1"]
    ledger.note_speed("base, acting", SPEED)
    ledger.note_speed("reader, asked", SPEED)
    cost = cost_of([Work(plain, 0, 10), Work(reader, 0, 40)], ledger)
    assert cost.seconds == {"base/plain": 10 * 40 * 0.25, "reader/p1": 40 * 0.25}
    assert set(cost.sources.values()) == {"calibrated"}
    other = replace(plain, settings=plain.settings.changed(batch=8))
    assert cost_of([Work(other, 0, 10)], ledger).unmeasured == ("base",)
    assert cost_of([Work(plain, 5, 10, 2.0)], ledger).sources == {"base": "stored episodes"}


def test_bytes_come_from_stored_streams_of_the_model_or_from_a_calibration(
    cells: dict[str, Cell], ledger: Ledger
) -> None:
    plain, dark = cells["base/plain"], cells["base/dark"]
    activations = 2 * 4 * 64 * 2 * 4  # rows and columns, of layers, features, views and float32
    expected = activations + 4 * 16 + EPISODE + THUMBNAILS
    stored, new = Work(plain, 10, 3, 1.0, STREAMS), Work(dark, 0, 2)
    assert cost_of([stored, new], ledger).bytes == {"base": 5 * expected}
    assert cost_of([new], ledger).unsized == ("base",)
    ledger.note_speed("base, acting", SPEED)
    assert cost_of([new], ledger).bytes == {"base": 2000}
    every = replace(dark, settings=dark.settings.changed(tokens="all"))
    assert cost_of([Work(every, 0, 2)], ledger).unsized == ("base",)


def test_every_inference_takes_bytes_at_most(cells: dict[str, Cell], ledger: Ledger) -> None:
    plain = cells["base/plain"]
    most, rest = plain.settings.scene.max_steps, 4 * 16 + EPISODE + THUMBNAILS
    for later, bytes_of_later in (("all", 2 * 4 * 64 * 2 * 4), ("mean", 2 * 4 * 64 * 2)):
        every = replace(plain, settings=plain.settings.changed(captured_calls="all", later_views=later))
        expected = 2 * 4 * 64 * 2 * 4 + (most - 1) * bytes_of_later + rest
        assert cost_of([Work(every, 10, 1, 1.0, STREAMS)], ledger).bytes == {"base": expected}


def test_nothing_missing_takes_nothing(cells: dict[str, Cell], ledger: Ledger) -> None:
    cost = cost_of([Work(cells["base/plain"], 96, 0, 1.0, STREAMS)], ledger)
    assert cost.to_json() == {
        "hours": {}, "hours_from": {}, "unmeasured": [], "bytes": {}, "unsized": [],
    }  # fmt: skip
