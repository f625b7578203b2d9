"""Playing of studies: resumed, each model loaded once, and a model that fails alone."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from probe_kit._execution.executor import GivenUp, TaskQueue
from probe_kit._terminal.console import out
from probe_kit.cli import app
from probe_kit.errors import RunDamagedError, RunIncompleteError, UsageError
from probe_kit.extract import ExtractSettings
from probe_kit.hooks import load_policy
from probe_kit.runs import open_run
from probe_kit.study import StudyFailure, conduct_study, fit_probes, load_study, make_table, plan_study, playing
from probe_kit.study.cells import Failures, PlannedRun
from probe_kit.study.playing import EpisodeStored, ModelTask, RunFinished, RunTask
from probe_kit.study.stored import open_cell
from probe_kit.suite import Suite
from tests.study.broken_files import BASE
from tests.study.small_study import LIGHT, SCRIPTED, small_study

BROKEN = '[models.broken]\nfamily = "pi0-tiny"\ncheckpoint = "{out}/nowhere"\n\n[models.idle]'
SHORT = LIGHT.replace("[models.idle]", BROKEN).replace('["expert", "idle"]', '["expert", "broken", "idle"]')
TEXT = f"""{SHORT}
[tables.main]
kind = "success"
runs = ["main"]

[tables.light]
kind = "ablation"
comparison = "light"
"""


@pytest.fixture(scope="module")
def file(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_study(tmp_path_factory.mktemp("study"), small_suite, TEXT, items=2)


def states(file: Path) -> dict[str, tuple[str, int]]:
    return {planned.cell.name: (planned.state, planned.stored) for planned in plan_study(load_study(file)).cells}


@pytest.mark.slow
def test_a_model_that_fails_stops_itself_alone_and_the_rest_is_played_once(file: Path) -> None:
    assert set(states(file).values()) == {("new", 0)}
    failed_models: list[str] = []
    (failure,) = conduct_study(
        plan_study(load_study(file)),
        lambda event: failed_models.append(event.model) if isinstance(event, StudyFailure) else None,
        env_workers=0,
    )
    assert (failure.model, failure.run, failed_models) == ("broken", "broken/short", ["broken"])
    assert "nowhere" in failure.reason
    after = {
        "expert/short": ("whole", 4),
        "broken/short": ("failed", 0),
        "idle/short": ("whole", 4),
        "idle/dark": ("whole", 4),
    }
    assert states(file) == after
    files = {path: path.stat().st_mtime_ns for path in file.parent.rglob("*") if path.is_file()}
    conduct_study(plan_study(load_study(file)), env_workers=0)
    assert {path: path.stat().st_mtime_ns for path in file.parent.rglob("*") if path.is_file()} == files
    run_location = next(
        planned.location for planned in plan_study(load_study(file)).cells if planned.cell.name == "idle/dark"
    )
    before = open_run(run_location).stamp
    sorted((Path(run_location) / "commits").iterdir())[2].unlink()
    assert open_run(run_location, allow_partial=True).planned == 4
    assert states(file)["idle/dark"] == ("partial", 3)
    conduct_study(plan_study(load_study(file), only="light"), env_workers=0)
    assert states(file) == after
    assert open_run(run_location).stamp == before


def test_the_commands_print_the_plan_and_say_by_their_exit_code_whether_it_is_whole(file: Path) -> None:
    run = CliRunner()
    plain = run.invoke(app, ["study", "run", str(file), "--dry-run"])
    assert plain.exit_code == 0
    assert "4 runs, 16 episodes (16 acted, 0 captured without acting, 0 asked)" in plain.stdout
    answer = json.loads(run.invoke(app, ["study", "run", str(file), "--dry-run", "--json"]).stdout)
    assert [run_row["model"] for run_row in answer["runs"]] == ["expert", "broken", "idle", "idle"]
    assert run.invoke(app, ["study", "run", str(file), "--dry-run", "--exit-code"]).exit_code == 1
    assert run.invoke(app, ["study", "run", str(file), "--dry-run", "--only", "absent-block"]).exit_code == 2
    for option in ("--exit-code", "--verify", "--orphans"):
        alone = run.invoke(app, ["study", "run", str(file), option])
        assert alone.exit_code == 2
        assert f"{option} looks at what is stored and plays nothing; give it with --dry-run" in " ".join(
            alone.stderr.split()
        )


@pytest.mark.slow
def test_tables_are_made_of_stored_runs_alone_and_name_what_is_missing(file: Path) -> None:
    conduct_study(plan_study(load_study(file)), env_workers=0)
    study = load_study(file)
    with pytest.raises(RunIncompleteError, match=r"broken/short is not whole: .* \(--partial\)"):
        make_table(study, "main")
    table = make_table(study, "main", partial=True)
    assert table.columns == ("system", "Color", "mean", "score")
    assert [cells[0] for cells in table.texts] == ["expert", "idle"]
    (failure,) = (planned.failure for planned in plan_study(study).cells if planned.failure)
    assert "; ".join(table.notes).endswith(f"broken · short is missing: {failure.reason}")
    assert table.is_partial
    light = make_table(study, "light")
    assert [cells[:3] for cells in light.texts] == [
        ("idle · dark − idle · short", name, "+0.0 [-100.0, +100.0]") for name in ("Color", "mean")
    ]
    with pytest.raises(UsageError, match=r"unknown table 'man'; known: main, light\. Did you mean 'main'"):
        make_table(study, "man")
    run = CliRunner()
    assert run.invoke(app, ["study", "table", str(file), "light"]).exit_code == 0
    latex = run.invoke(app, ["study", "table", str(file), "light", "--format", "latex"]).stdout
    assert r"\begin{tabular}" in latex
    answer = json.loads(run.invoke(app, ["study", "table", str(file), "light", "--format", "json"]).stdout)
    assert [(record["category"], record["items"], record["of_items"]) for record in answer["numbers"]] == [
        ("color", 2, 2),
        ("mean", 2, 2),
    ]


@pytest.mark.slow
def test_a_file_that_asks_for_more_items_plays_the_missing_ones_alone(file: Path) -> None:
    conduct_study(plan_study(load_study(file)), env_workers=0)
    more = file.with_name("more.toml")
    more.write_text(file.read_text(encoding="utf-8").replace("items = 2", "items = 4"), encoding="utf-8")
    assert states(more)["expert/short"] == ("partial", 4)
    run_folder = Path(
        next(
            planned.location
            for planned in plan_study(load_study(more)).cells
            if planned.cell.name == "expert/short"
        )
    )
    before = {path.name: path.read_bytes() for path in (run_folder / "commits").iterdir()}
    conduct_study(plan_study(load_study(more), only="expert"), env_workers=0)
    assert states(more)["expert/short"] == ("whole", 8)
    assert states(file)["expert/short"] == ("whole", 4)  # more than what it needs
    after = {path.name: path.read_bytes() for path in (run_folder / "commits").iterdir()}
    assert len(after) == 8
    assert {name: after[name] for name in before} == before
    items_by_system = {
        record["system"]: record["items"] for record in make_table(load_study(file), "main", partial=True).numbers
    }
    assert items_by_system["expert"] == 2


@pytest.mark.slow
def test_every_scene_is_built_before_the_first_run_is_played(file: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.png"
    torn.write_text("no picture", encoding="utf-8")
    text = file.read_text(encoding="utf-8").replace(str(load_study(file).study.folder), str(tmp_path / "out"))
    changed = tmp_path / "study.toml"
    scene = f'rendering = "visual-matching"\nbackground = "{torn}"'
    changed.write_text(text.replace("light_level = 0.7", scene), encoding="utf-8")
    events: list[object] = []
    failures = conduct_study(plan_study(load_study(changed)), events.append, env_workers=0)
    assert [(failure.stage, failure.run) for failure in failures] == [
        ("checking", "broken/short"),
        ("checking", "idle/dark"),
    ]
    assert [type(event).__name__ for event in events][:3] == ["StudyFailure", "StudyFailure", "EpisodeStored"]
    assert states(changed)["idle/short"] == ("waiting", 0)
    assert states(changed)["expert/short"] == ("whole", 4)
    changed.write_text(text, encoding="utf-8")  # what failed before it played is tried again unasked
    conduct_study(plan_study(load_study(changed)), env_workers=0)
    assert states(changed)["idle/short"] == states(changed)["idle/dark"] == ("whole", 4)


@pytest.mark.slow
def test_a_run_that_fails_is_stored_with_its_traceback_and_played_again_on_request(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = file.read_text(encoding="utf-8").replace(str(load_study(file).study.folder), str(tmp_path / "out"))
    text = text.replace(f'checkpoint = "{tmp_path / "out"}/nowhere"', "random_weights = true")
    changed = tmp_path / "study.toml"
    changed.write_text(text, encoding="utf-8")
    tries: list[str] = []

    def load(family: str, *_: object) -> None:
        tries.append(family)
        raise RuntimeError("the loader of a family is wrong")

    monkeypatch.setattr("probe_kit.hooks.load_policy", load)
    for retry_failed, tried in ((False, 1), (False, 1), (True, 2)):
        (failure,) = conduct_study(plan_study(load_study(changed)), env_workers=0, retry_failed=retry_failed)
        assert (failure.stage, failure.error, failure.run) == ("playing", "RuntimeError", "broken/short")
        assert "raise RuntimeError" in failure.traceback
        assert len(tries) == tried
    assert states(changed)["broken/short"] == ("failed", 0)
    assert states(changed)["idle/dark"] == ("whole", 4)
    monkeypatch.setattr(out, "_width", 200)
    result = CliRunner().invoke(app, ["study", "run", str(changed), "--dry-run", "--exit-code"])
    assert result.exit_code == 1
    assert "the loader of a family is wrong" in result.stdout


@pytest.mark.slow
def test_a_policy_is_loaded_once_for_all_of_its_runs(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[str] = []

    def count(family, *arguments, **options):  # type: ignore[no-untyped-def]
        loaded.append(family)
        return load_policy(family, *arguments, **options)

    monkeypatch.setattr("probe_kit.hooks.load_policy", count)
    text = TEXT.replace('family = "idle"', 'family = "pi0-tiny"\nrandom_weights = true')
    file = small_study(tmp_path, small_suite, text, items=2)
    assert [event.model for event in conduct_study(plan_study(load_study(file)), env_workers=0)] == ["broken"]
    assert loaded == ["pi0-tiny"]
    assert states(file)["idle/dark"] == states(file)["idle/short"] == ("whole", 4)


TWO_TARGETS = """
[models.idle]
family = "idle"

[conditions.short]
max_steps = 1

[[runs]]
name = "few"
models = ["idle"]
conditions = ["short"]
items = 10

[[runs]]
name = "main"
models = ["idle"]
conditions = ["short"]

[probes.chosen]
runs = ["few"]
target = "side.chosen"

[probes.main]
runs = ["main"]
"""


@pytest.mark.slow
def test_a_run_is_probed_in_the_items_of_the_probes_that_tables_show(small_suite: Suite, tmp_path: Path) -> None:
    study = load_study(small_study(tmp_path, small_suite, TWO_TARGETS))
    assert conduct_study(plan_study(study), env_workers=0) == []
    (cell,) = study.cells
    stored = open_cell(study, cell, cell.selections["few"])
    assert [run.items.shape[0] for run in (stored.run, stored.probed)] == [10, 12]


@pytest.mark.slow
def test_probes_of_the_file_are_fitted_once_and_shown(small_suite: Suite, tmp_path: Path) -> None:
    network = 'family = "pi0-tiny"\nrandom_weights = true'
    text = TEXT.replace('family = "idle"', f'{network}\nuntrained = "expert"\nweights_seed = 1')
    text = text.replace('family = "expert"', network)
    probes = '[probes.main]\nruns = ["main"]\npermutations = 19\ncontrols = ["position"]\n'
    probing = '[tables.probing]\nkind = "probing"\nruns = ["main"]\n'
    file = small_study(tmp_path, small_suite, f"{text}{probes}{probing}")
    study = load_study(file)
    conduct_study(plan_study(study))
    (missing,) = fit_probes(plan_study(study))
    assert (missing.run, missing.stage) == ("broken/short", "waiting")
    table = make_table(study, "probing", partial=True)
    assert [cells[:3] for cells in table.texts] == [
        (name, "mean", category) for name in ("expert", "idle") for category in ("Color", "mean")
    ]
    stored = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("probes/*/*") if path.name == "scores.csv"}
    assert len(stored) == 2
    fit_probes(plan_study(study))
    assert {path: path.stat().st_mtime_ns for path in stored} == stored


@pytest.mark.slow
def test_probes_are_compared_again_where_the_file_names_another_untrained_network(
    small_suite: Suite, tmp_path: Path
) -> None:
    file = small_study(tmp_path, small_suite)
    text = file.read_text(encoding="utf-8")

    def words() -> str:
        cells = plan_study(load_study(file), only="main").cells
        return next(planned.words for planned in cells if planned.cell.name == "first/still")

    def play_and_fit() -> None:
        assert conduct_study(plan_study(load_study(file), only="main"), env_workers=0) == []
        assert fit_probes(plan_study(load_study(file), only="main")) == []

    play_and_fit()
    assert words() == "whole; probed"
    file.write_text(text.replace("weights_seed = 1", "weights_seed = 2"), encoding="utf-8")
    assert words() == "whole; probes main: not compared with its untrained network"
    play_and_fit()
    assert words() == "whole; probed"
    file.write_text(text, encoding="utf-8")
    assert words() == "whole; probes main: compared with another untrained network"


SETTINGS = ExtractSettings("expert")


def task(model: str, size: float, gpus: int = 0) -> ModelTask:
    runs = tuple(RunTask(f"{model}/{way}", SETTINGS, way, 0) for way in ("plain", "dark"))
    return ModelTask(model, runs, gpus, size)


def conducted(monkeypatch: pytest.MonkeyPatch, tasks: list[ModelTask], story: Any, **where: Any) -> list[Any]:
    """The events that are reported while `story` plays the queue in place of workers."""
    reports: list[Any] = []
    monkeypatch.setattr(playing, "work_off", lambda _pool, queue: story(queue))
    playing.play_models(tasks, reports.append, **where)
    return reports


def test_the_longest_model_goes_first_and_one_with_a_gpu_only_where_there_is_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(
        __import__("sys").modules, "torch", SimpleNamespace(cuda=SimpleNamespace(device_count=lambda: 1))
    )

    def story(queue: TaskQueue[ModelTask]) -> Iterator[tuple[int, Any]]:
        assert [queue.take(slot) for slot in (1, 0, 2, 0)] == [
            task("middle", 2), task("long", 3, gpus=1), task("short", 1), None,
        ]  # fmt: skip
        for slot, played in ((1, "middle"), (0, "long"), (2, "short")):
            assert not queue.finished
            yield slot, task(played, 0)
        assert queue.finished

    assert (
        conducted(monkeypatch, [task("short", 1), task("long", 3, gpus=1), task("middle", 2)], story, slots=3)
        == []
    )


def test_a_lost_model_comes_back_without_the_runs_that_are_made_or_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    finished = RunFinished("base", "base/plain")
    failed = StudyFailure(stage="episodes", model="base", run="base/dark", reason="two of them")

    def story(queue: TaskQueue[ModelTask]) -> Iterator[tuple[int, Any]]:
        queue.take(0)
        for slot, event, remaining in ((0, finished, ["base/dark"]), (1, failed, [])):
            yield slot, event
            queue.retry(slot, "base", counts=False)
            again = queue.take(slot + 1)
            assert again is not None
            assert [run.run for run in again.runs] == remaining

    assert conducted(monkeypatch, [task("base", 1)], story, slots=1) == [finished, failed]


def test_a_model_is_given_up_after_three_losses_without_an_episode_in_between(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    moved = EpisodeStored("base", "base/plain", 1, 4, "correct")

    def story(queue: TaskQueue[ModelTask]) -> Iterator[tuple[int, Any]]:
        def lose() -> tuple[ModelTask, bool]:
            job = queue.take(0)
            assert job is not None
            return job, queue.retry(0, "base")

        assert all(lose()[1] for _ in range(2))
        queue.take(0)
        yield 0, moved
        assert queue.retry(0, "base")
        assert lose()[1]
        job, again = lose()
        assert not again
        yield 0, GivenUp(job, "worker 0 ended with code -11")
        assert queue.finished

    reports = conducted(monkeypatch, [task("base", 1)], story, slots=1)
    assert reports[0] == moved
    failure = reports[1]
    assert (failure.stage, failure.run, failure.error) == ("playing", "base/plain", "WorkerDiedError")
    assert failure.reason.startswith("worker 0 ended with code -11, 3 times without an episode in between")


FAILURE = StudyFailure(stage="playing", model="base", run="base/dark", reason="no memory", when="noon")


@pytest.fixture
def study_file(tmp_path: Path) -> Path:
    file = tmp_path / "study.toml"
    file.write_text(BASE.replace("runs/small", str(tmp_path / "out")), encoding="utf-8")
    return file


@pytest.fixture
def cell(study_file: Path) -> PlannedRun:
    return next(cell for cell in load_study(study_file).cells if cell.name == "base/dark")


@pytest.fixture
def failures(tmp_path: Path) -> Failures:
    return Failures(str(tmp_path / "out"))


def test_a_failure_is_stored_once_and_cleared(cell: PlannedRun, failures: Failures, tmp_path: Path) -> None:
    assert failures.of(cell) is None
    failures.note(cell, FAILURE)
    (file,) = (tmp_path / "out" / "failures").iterdir()
    assert file.name == f"base+dark-{cell.key}.json"
    before = file.stat()
    failures.note(cell, FAILURE.model_copy(update={"when": "later"}))
    assert (file.stat().st_ino, file.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    failures.note(cell, FAILURE.model_copy(update={"stage": "probes"}), "main")
    assert FAILURE.same(failures.of(cell))
    failures.clear(cell)
    assert failures.of(cell) is None
    assert failures.of(cell, "main") is not None


def test_what_a_killed_process_left_aside_is_removed(cell: PlannedRun, failures: Failures, tmp_path: Path) -> None:
    failures.note(cell, FAILURE)
    draft = tmp_path / "out" / "failures" / "left.tmp"
    draft.touch()
    failures.check_place()
    assert not draft.exists()


@pytest.mark.parametrize("content", ["", "[]", '{"run": 1}', '{"run": "base/dark"}'])
def test_a_record_that_is_none_is_named(
    cell: PlannedRun, failures: Failures, tmp_path: Path, content: str
) -> None:
    failures.note(cell, FAILURE)
    (file,) = (tmp_path / "out" / "failures").iterdir()
    file.write_text(content, encoding="utf-8")
    with pytest.raises(RunDamagedError, match=rf"{re.escape(file.name)} .*Delete it; no number"):
        failures.of(cell)


def test_a_failure_has_its_traceback_and_equals_the_same_one_later() -> None:
    def failed() -> StudyFailure:
        try:
            raise ValueError("no such layer")
        except ValueError as error:
            return StudyFailure.of("playing", "base", "base/dark", error)

    failure, again = failed(), failed()
    assert str(failure) == "base failed at base/dark: no such layer"
    assert "in failed\n" in failure.traceback
    assert failure.error == "ValueError"
    assert failure.same(again.model_copy(update={"when": "later", "traceback": ""}))
    assert not failure.same(again.model_copy(update={"reason": "another layer"}))
    assert not failure.same(None)


def test_a_plan_names_failures_and_what_waits_for_them(
    study_file: Path, cell: PlannedRun, failures: Failures
) -> None:
    failures.note(cell, FAILURE)
    states = {
        planned.cell.name: (planned.state, planned.why) for planned in plan_study(load_study(study_file)).cells
    }
    assert states["base/dark"] == ("failed", "failed (noon): no memory")
    assert states["base/plain"] == ("waiting", "new; waits, because base/dark failed")
    assert states["state/plain"] == ("new", "new")
    failures.note(cell, FAILURE.model_copy(update={"stage": "episodes"}))
    assert whys(study_file)["base/plain"] == "new"


def test_a_failure_of_former_settings_is_none(study_file: Path, cell: PlannedRun, failures: Failures) -> None:
    failures.note(cell, FAILURE)
    text = study_file.read_text(encoding="utf-8")
    study_file.write_text(text.replace("light_level = 0.7", "light_level = 0.6"), encoding="utf-8")
    assert whys(study_file)["base/dark"] == "new"


def whys(file: Path) -> dict[str, str]:
    return {planned.cell.name: planned.why for planned in plan_study(load_study(file)).cells}


@pytest.mark.slow
def test_a_plan_says_what_changed_since_a_run_of_the_same_name(small_suite: Suite, tmp_path: Path) -> None:
    file = small_study(tmp_path, small_suite, SCRIPTED, items=6)
    assert conduct_study(plan_study(load_study(file)), env_workers=0) == []
    assert set(whys(file).values()) == {"whole"}
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("light_level = 0.7", "light_level = 0.6"), encoding="utf-8")
    expected = {"plain": "whole", "dark": "new: light_level 0.7 → 0.6"}
    assert whys(file) == {f"{model}/{way}": why for model in ("expert", "idle") for way, why in expected.items()}
