"""Hours by stored episodes, and bytes, of what a study lacks."""

from dataclasses import replace
from pathlib import Path

import pytest

from probe_kit.extract.plan import EPISODE, THUMBNAILS
from probe_kit.runs.layout import StoredStream
from probe_kit.study import LoadedStudy, StudyPlan, load_study
from probe_kit.study.cells import Cell
from probe_kit.study.plan import PlannedCell, State
from tests.study.broken_files import BASE

STREAMS = (StoredStream("backbone", 4, 64, None, 150, ("mean", "last")),)


@pytest.fixture
def study(tmp_path: Path) -> LoadedStudy:
    file = tmp_path / "study.toml"
    file.write_text(BASE, encoding="utf-8")
    return load_study(file)


@pytest.fixture
def cells(study: LoadedStudy) -> dict[str, Cell]:
    return {cell.name: cell for cell in study.cells}


def planned(
    cell: Cell, missing: int, seconds: float | None = None, streams: tuple[StoredStream, ...] | None = None
) -> PlannedCell:
    """A cell of which these episodes are missing."""
    stored = cell.episodes - missing
    state: State = "whole" if not missing else "partial" if stored else "new"
    return PlannedCell(cell, "", state, stored, "", seconds=seconds, streams=streams)


def test_hours_come_from_stored_episodes_of_the_model_by_inferences(
    study: LoadedStudy, cells: dict[str, Cell]
) -> None:
    plain, dark = cells["base/plain"], cells["base/dark"]
    short = replace(
        plain, way="short", settings=plain.settings.changed(scene=replace(plain.settings.scene, max_steps=20))
    )
    assert (plain.units, short.units) == (40, 20)
    reader = planned(cells["reader/p1"], 40)
    plan = StudyPlan(study, (planned(plain, 90, 8.0), planned(short, short.episodes), planned(dark, 0), reader))
    assert plan.seconds == pytest.approx({"base/plain": 90 * 8.0, "base/short": short.episodes * 4.0})
    assert plan.hours() == {"base": pytest.approx((720 + 4 * short.episodes) / 3600), "reader": None}
    assert "hours unknown before a first episode is stored: reader" in plan.lines()


def test_bytes_come_from_stored_streams_of_the_model(study: LoadedStudy, cells: dict[str, Cell]) -> None:
    plain, dark = cells["base/plain"], cells["base/dark"]
    activations = 2 * 4 * 64 * 2 * 4  # rows and columns, of layers, features, views and float32
    expected = activations + 4 * 16 + EPISODE + THUMBNAILS
    stored, new = planned(plain, 3, 1.0, STREAMS), planned(dark, 2)
    assert StudyPlan(study, (stored, new)).bytes() == {"base": 5 * expected}
    assert StudyPlan(study, (new,)).bytes() == {"base": None}


def test_every_inference_takes_bytes_at_most(study: LoadedStudy, cells: dict[str, Cell]) -> None:
    plain = cells["base/plain"]
    most, fixed = plain.settings.scene.max_steps, 4 * 16 + EPISODE + THUMBNAILS
    for later, bytes_of_later in (("all", 2 * 4 * 64 * 2 * 4), ("mean", 2 * 4 * 64 * 2)):
        every = replace(plain, settings=plain.settings.changed(captured_calls="all", later_views=later))
        expected = 2 * 4 * 64 * 2 * 4 + (most - 1) * bytes_of_later + fixed
        assert StudyPlan(study, (planned(every, 1, 1.0, STREAMS),)).bytes() == {"base": expected}


def test_nothing_missing_takes_nothing(study: LoadedStudy, cells: dict[str, Cell]) -> None:
    plan = StudyPlan(study, (planned(cells["base/plain"], 0, 1.0, STREAMS),))
    assert (plan.hours(), plan.bytes(), plan.seconds) == ({}, {}, {})
