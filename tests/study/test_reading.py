"""Study files: mistakes with their paths, all at once, and what a correct one expands to."""

import os
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from probe_kit.errors import UsageError
from probe_kit.extract import ExtractSettings
from probe_kit.extract.sizes import EPISODE, THUMBNAILS
from probe_kit.runs.layout import StoredStream
from probe_kit.study import LoadedStudy, StudyFileError, StudyPlan, load_study, make_table, plan_study
from probe_kit.study.cells import PlannedRun
from probe_kit.study.expansion import control_of
from probe_kit.study.plan import PlannedCell, State
from probe_kit.suite import Suite
from tests.study.broken_files import BASE, ELSEWHERE, MISTAKES


def written(folder: Path, text: str = BASE) -> Path:
    file = folder / "study.toml"
    file.write_text(text, encoding="utf-8")
    return file


def changed(*changes: tuple[str, str]) -> str:
    text = BASE
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


def fields_at(text: str, marker: str) -> list[str]:
    """The tables and keys that stand on the lines with `marker`, such as `models.base.vlm` or `runs[0]`."""
    starts = [start for start in range(len(text)) if text.startswith(marker, start)]
    return [field_at(text[: (text + "\n").index("\n", start)].splitlines()) for start in starts]


def field_at(lines: list[str]) -> str:
    """The field on the last of these lines."""
    plain = [line.partition("#")[0].strip() for line in lines]
    headers = [line for line in plain if line.startswith("[") and line.endswith("]") and "=" not in line]
    table = headers[-1].strip("[]") if headers else ""
    if headers and headers[-1].startswith("[["):
        table += f"[{headers.count(headers[-1]) - 1}]"
    if plain[-1] in headers:
        return table
    return f"{table}.{plain[-1].partition(' = ')[0]}".removeprefix(".")


def is_in(path: str, field: str) -> bool:
    return path == field or path.startswith((f"{field}.", f"{field}["))


@pytest.mark.parametrize(
    ("old", "new", "mistake_path"), MISTAKES, ids=[new.strip()[:40] for _, new, _ in MISTAKES]
)
def test_a_mistake_is_named_with_its_path_and_nothing_else_is_raised(
    tmp_path: Path, old: str, new: str, mistake_path: str
) -> None:
    text = changed((old, new))
    file = written(tmp_path, text)
    with pytest.raises(StudyFileError) as caught:
        load_study(file)
    (field,) = fields_at(text, "# here") or fields_at(text, ELSEWHERE[mistake_path])[:1]
    mistakes = dict(zip(str(caught.value).splitlines(), caught.value.mistakes, strict=True))
    paths = [mistake.field for line, mistake in mistakes.items() if mistake_path in line]
    assert any(is_in(path, field) for path in paths), (field, str(caught.value))
    assert all(line == f"{file}: {mistake.field}: {mistake.text}" for line, mistake in mistakes.items())
    assert caught.value.exit_code == 2


def test_wrong_names_are_said_together_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = changed(
        ('vlm = "reader"', 'vlm = "raeder"  # here'),
        ('asks = ["p1", "p2"]', 'asks = ["p1", "p3"]  # here'),
        ("permutations = 100", "permutations = 3"),
        ('comparison = "light"', 'comparison = "dark"  # here'),
    )
    with pytest.raises(StudyFileError) as caught:
        load_study(written(tmp_path, text))
    assert [mistake.field for mistake in caught.value.mistakes] == fields_at(text, "# here")


def test_contradictions_of_a_study_file_are_listed_together_in_the_files_order(tmp_path: Path) -> None:
    text = changed(
        ("items = 24", "items = 200  # here"),
        ("light_level = 0.7", "light_level = -1.0  # here"),
        ('prompt = "p2"', 'prompt = "p9"  # here'),
        ("permutations = 100", "permutations = 3  # here"),
        ('comparison = "light"', 'comparison = "tuning"  # here'),
    )
    with pytest.raises(StudyFileError) as caught:
        load_study(written(tmp_path, text))
    assert [mistake.field for mistake in caught.value.mistakes] == fields_at(text, "# here")


def test_wrong_values_are_said_together_before_names_are_looked_at(tmp_path: Path) -> None:
    text = changed(
        ("items = 24", "items = 23  # here"),
        ('vlm = "reader"', 'vln = "reader"  # here'),
        ("random_weights = true", 'random_weights = "yes"  # here'),
        ("light_level = 0.7", 'light_level = "dark"  # here'),
        ('conditions = ["plain"]', 'conditions = "plain"  # here'),
        ('models = ["base", "state"]\n', 'models = ["base", "stats"]\n'),
        ("permutations = 100", 'permutations = "all"  # here'),
    )
    with pytest.raises(StudyFileError) as caught:
        load_study(written(tmp_path, text))
    paths = [mistake.field for mistake in caught.value.mistakes]
    assert paths == fields_at(text, "# here")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a = = 1", "line 1, column 5.*must be TOML"),
        ("schema = 1\nschema = 1", "overwrite.*must be TOML"),
        ("a = [\n1,\n", "Invalid value .*end of document"),
        ("", "is missing"),
        (f"a = {'[' * 3000}{']' * 3000}", "nest too deeply"),
    ],
    ids=["no value", "a key twice", "an open list", "nothing", "deep"],
)
def test_a_study_file_that_is_empty_or_no_toml_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        load_study(written(tmp_path, text))
    with pytest.raises(UsageError, match="or one of embedded, paper"):
        load_study(tmp_path / "other.toml")


def test_a_byte_order_mark_is_read_over(tmp_path: Path) -> None:
    assert keys(load_study(written(tmp_path, f"\ufeff{BASE}"))) == keys(load_study(written(tmp_path)))


# -- expansion ---------------------------------------------------------------------------------------------------


def keys(study: LoadedStudy) -> dict[str, str]:
    return {cell.name: cell.key for cell in study.cells}


def test_blocks_that_ask_for_the_same_run_share_it(tmp_path: Path) -> None:
    study = load_study(written(tmp_path))
    assert list(keys(study)) == [
        "base/plain", "state/plain", "random/plain", "random-state/plain", "base/dark", "reader/p1", "reader/p2",
    ]  # fmt: skip
    base = study.cells[0]
    assert list(base.selections) == ["main", "light"]
    assert (base.selection.categories, base.n_items, base.episodes) == (("color", "shape"), 48, 96)
    assert base.inferences == 96 * 40
    assert len(set(keys(study).values())) == 7


@pytest.mark.parametrize(
    ("old", "new", "other"),
    [
        ('name = "small"', 'name = "tiny"', set()),
        ('groups = ["one"]', 'groups = ["one"]\nlabel = "π0"', set()),
        ("light_level = 0.7", "light_level = 0.7 # 30 % less", set()),
        ('["base", "state", "random", "random-state"]', '["random", "base", "random-state", "state"]', set()),
        ('categories = ["color", "Shape"]', 'categories = ["color", "Shape", "traffic"]', set()),
        ("items = 24", "items = 30", set()),
        ("permutations = 100", "permutations = 300", set()),
        ("light_level = 0.7", "light_level = 0.6", {"base/dark"}),
        ('prompt = "p2"', 'prompt = "seen"', {"reader/p2"}),
        ('family = "vlm-tiny"', 'family = "vlm-tiny"\nscene = "bridge"', {"reader/p1", "reader/p2"}),
    ],
)  # fmt: skip
def test_one_change_makes_other_runs_of_what_it_concerns_alone(
    tmp_path: Path, old: str, new: str, other: set[str]
) -> None:
    before, after = keys(load_study(written(tmp_path))), keys(load_study(written(tmp_path, changed((old, new)))))
    assert {name for name in before if after[name] != before[name]} == other


def test_a_byte_of_a_checkpoint_makes_other_runs_of_its_model(tmp_path: Path) -> None:
    weights = tmp_path / "weights" / "model.safetensors"
    weights.parent.mkdir()
    weights.write_bytes(b"one")
    text = changed(('vlm = "reader"', f'vlm = "reader"\ncheckpoint = "{weights.parent}"'))
    before = keys(load_study(written(tmp_path, text)))
    weights.write_bytes(b"other")
    after = keys(load_study(written(tmp_path, text)))
    assert {name for name in before if after[name] != before[name]} == {"base/plain", "base/dark"}


def test_a_condition_captures_a_number_of_inferences_or_all(tmp_path: Path) -> None:
    dark = "light_level = 0.7"
    for toml_value, expected in (("3", 3), ('"all"', "all")):
        text = changed((dark, f'{dark}\ncaptured_calls = {toml_value}\nlater_views = "mean"'))
        (cell,) = (
            study_cell
            for study_cell in load_study(written(tmp_path, text)).cells
            if study_cell.name == "base/dark"
        )
        assert isinstance(cell.settings, ExtractSettings)
        assert (cell.settings.capture.captured_calls, cell.settings.capture.later_views) == (expected, "mean")


CAPTURED = """
[conditions.captured]
no_act = true
{scene}

[[runs]]
name = "captured"
models = ["random", "random-state"]
conditions = ["captured"]
"""


def test_a_control_is_in_the_same_condition_or_captured_in_the_same_scene(tmp_path: Path) -> None:
    study = load_study(written(tmp_path))
    cells = {cell.name: cell for cell in study.cells}
    assert control_of(study.study, study.cells, cells["base/plain"]) == cells["random/plain"]
    assert control_of(study.study, study.cells, cells["random/plain"]) is None
    main = 'models = ["base", "state", "random", "random-state"]'
    other_changes = (main, 'models = ["base", "state"]'), ('controls = ["', 'controls = ["untrained", "')
    alike = written(tmp_path, changed(other_changes[0]) + CAPTURED.format(scene=""))
    study = load_study(alike)
    cells = {cell.name: cell for cell in study.cells}
    assert control_of(study.study, study.cells, cells["state/plain"]) == cells["random-state/captured"]
    elsewhere = written(tmp_path, changed(other_changes[0]) + CAPTURED.format(scene="light_level = 0.5"))
    with pytest.raises(StudyFileError, match="'random', the control of base/plain, has no run in the same scene"):
        load_study(elsewhere)


def test_seeds_and_wordings_multiply_episodes(tmp_path: Path) -> None:
    text = changed(
        ("light_level = 0.7", 'light_level = 0.7\nwordings = ["knowledge", "named"]'),
        ('conditions = ["plain"]', 'conditions = ["plain"]\nseeds = [0, 7]'),
    )
    study = load_study(written(tmp_path, text))
    episodes = {cell.name: cell.episodes for cell in study.cells}
    assert (episodes["base/plain"], episodes["base/plain/seed 7"], episodes["base/dark"]) == (96, 96, 96)
    places = {cell.location("out") for cell in study.cells}
    assert len(places) == len(study.cells)
    assert any(folder_name.startswith("out/base/plain-seed7-") for folder_name in places)


# -- studies of the package --------------------------------------------------------------------------------------


def test_the_papers_study_is_41_runs_of_107_440_episodes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    plan = plan_study(load_study("paper"))
    assert plan.totals() == {
        "runs": 41,
        "episodes": 107_440,
        "acted": 45_520,
        "captured": 3_440,
        "asked": 58_480,
        "inferences": 3_438_640,
        "missing": 107_440,
        "unprobed": 0,
    }
    assert list(plan.skipped()) == ["pi0-paraphrases", "pi0-distill"]
    assert len(plan.study.study.models) == 20
    scenes = {planned_run.cell.settings.scene.name for planned_run in plan.cells}
    assert scenes == {"act2answer"}  # policies and VLMs: else they would see other frames
    checkpoints = {
        planned_run.cell.model: planned_run.cell.settings.model.checkpoint
        for planned_run in plan.cells
        if planned_run.cell.way == "plain"
    }
    assert checkpoints["openvla"] == "openvla/openvla-7b"
    assert checkpoints["openvla-sft"] == "gen-robot/openvla-7b-rlvla-sft_16k"


def test_the_embedded_study_needs_no_download(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    study = load_study("embedded")
    assert all(cell.settings.model.checkpoint is None for cell in study.cells)
    assert {cell.model for cell in study.cells} == set(study.study.models)
    assert plan_study(study).totals()["episodes"] == 1728


def test_paths_are_relative_to_the_working_directory_also_in_studies_of_the_package(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "suites").mkdir()
    (tmp_path / "suites" / "paper").symlink_to(small_suite.folder, target_is_directory=True)
    with pytest.raises(
        StudyFileError, match=r"suite.counts.Emotion: emotion has 0 items in suites/paper, not 150"
    ):
        load_study("paper")
    (tmp_path / "files").mkdir()
    text = changed(("[suite]", '[suite]\npath = "suites/paper"'), ("items = 24", "items = 12"))
    study = load_study(written(tmp_path / "files", text))
    assert study.suite.identity == f"{small_suite.name}@{small_suite.version}"  # a suite that grows keeps its runs
    assert study.cells[0].settings_to_play.source.suite == Path("suites/paper")


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "probe_kit", "study", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )


def stored(folder: Path) -> dict[Path, tuple[int, int]]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}


@pytest.mark.slow
def test_the_embedded_study_runs_to_all_tables_and_again_without_a_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    played = command(tmp_path, "run", "embedded", "--slots", "2")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert played.returncode == 0, played.stderr[-3000:]
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{time.monotonic() - began:.0f} s, {cpu:.0f} CPU seconds, load {os.getloadavg()[0]:.1f}")
    files = stored(tmp_path)
    again = command(tmp_path, "run", "embedded")
    assert again.returncode == 0, again.stderr[-3000:]
    assert "missing: 0 episodes" in again.stdout
    assert not [line for line in again.stderr.splitlines() if line.split("|")[-1].strip() == "torch"]
    assert stored(tmp_path) == files
    assert command(tmp_path, "run", "embedded", "--dry-run", "--exit-code").returncode == 0
    monkeypatch.chdir(tmp_path)
    study = load_study("embedded")
    for name in study.study.tables:
        assert make_table(study, name).numbers, name


STREAMS = (StoredStream("backbone", 4, 64, None, 150, ("mean", "last")),)


@pytest.fixture
def study(tmp_path: Path) -> LoadedStudy:
    file = tmp_path / "study.toml"
    file.write_text(BASE, encoding="utf-8")
    return load_study(file)


@pytest.fixture
def cells(study: LoadedStudy) -> dict[str, PlannedRun]:
    return {cell.name: cell for cell in study.cells}


def planned(
    cell: PlannedRun, missing: int, seconds: float | None = None, streams: tuple[StoredStream, ...] | None = None
) -> PlannedCell:
    """A cell of which these episodes are missing."""
    stored = cell.episodes - missing
    state: State = "whole" if not missing else "partial" if stored else "new"
    return PlannedCell(cell, "", state, stored, "", seconds=seconds, streams=streams)


def test_hours_come_from_stored_episodes_of_the_model_by_inferences(
    study: LoadedStudy, cells: dict[str, PlannedRun]
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


def test_bytes_come_from_stored_streams_of_the_model(study: LoadedStudy, cells: dict[str, PlannedRun]) -> None:
    plain, dark = cells["base/plain"], cells["base/dark"]
    activations = 2 * 4 * 64 * 2 * 4  # rows and columns, of layers, features, views and float32
    expected = activations + 4 * 16 + EPISODE + THUMBNAILS
    stored, new = planned(plain, 3, 1.0, STREAMS), planned(dark, 2)
    assert StudyPlan(study, (stored, new)).bytes() == {"base": 5 * expected}
    assert StudyPlan(study, (new,)).bytes() == {"base": None}


def test_every_inference_takes_bytes_at_most(study: LoadedStudy, cells: dict[str, PlannedRun]) -> None:
    plain = cells["base/plain"]
    most, fixed = plain.settings.scene.max_steps, 4 * 16 + EPISODE + THUMBNAILS
    for later, bytes_of_later in (("all", 2 * 4 * 64 * 2 * 4), ("mean", 2 * 4 * 64 * 2)):
        every = replace(plain, settings=plain.settings.changed(captured_calls="all", later_views=later))
        expected = 2 * 4 * 64 * 2 * 4 + (most - 1) * bytes_of_later + fixed
        assert StudyPlan(study, (planned(every, 1, 1.0, STREAMS),)).bytes() == {"base": expected}


def test_nothing_missing_takes_nothing(study: LoadedStudy, cells: dict[str, PlannedRun]) -> None:
    plan = StudyPlan(study, (planned(cells["base/plain"], 0, 1.0, STREAMS),))
    assert (plan.hours(), plan.bytes(), plan.seconds) == ({}, {}, {})
