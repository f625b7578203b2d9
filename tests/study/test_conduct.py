"""Playing of studies: resumed, each model loaded once, and a model that fails alone."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit._terminal.console import out
from probe_kit.cli import app
from probe_kit.errors import RunIncompleteError, UsageError
from probe_kit.hooks import load_policy
from probe_kit.runs import open_run
from probe_kit.study import (
    Failure,
    conduct_study,
    fit_probes,
    load_study,
    make_table,
    plan_study,
)
from probe_kit.study.stored import open_cell
from probe_kit.suite import Suite
from tests.study.small_study import LIGHT, small_study

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
    return {one.cell.name: (one.state, one.stored) for one in plan_study(load_study(file)).cells}


@pytest.mark.slow
def test_a_model_that_fails_stops_itself_alone_and_the_rest_is_played_once(file: Path) -> None:
    assert set(states(file).values()) == {("new", 0)}
    told: list[str] = []
    (failure,) = conduct_study(
        plan_study(load_study(file)),
        lambda event: told.append(event.model) if isinstance(event, Failure) else None,
        env_workers=0,
    )
    assert (failure.model, failure.run, told) == ("broken", "broken/short", ["broken"])
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
    place = next(one.location for one in plan_study(load_study(file)).cells if one.cell.name == "idle/dark")
    before = open_run(place).stamp
    sorted((Path(place) / "commits").iterdir())[2].unlink()
    assert open_run(place, allow_partial=True).planned == 4
    assert states(file)["idle/dark"] == ("partial", 3)
    conduct_study(plan_study(load_study(file), only="light"), env_workers=0)
    assert states(file) == after
    assert open_run(place).stamp == before


def test_the_commands_print_the_plan_and_say_by_their_exit_code_whether_it_is_whole(file: Path) -> None:
    run = CliRunner()
    plain = run.invoke(app, ["study", "run", str(file), "--dry-run"])
    assert plain.exit_code == 0
    assert "4 runs, 16 episodes (16 acted, 0 captured without acting, 0 asked)" in plain.stdout
    found = json.loads(run.invoke(app, ["study", "run", str(file), "--dry-run", "--json"]).stdout)
    assert [one["model"] for one in found["runs"]] == ["expert", "broken", "idle", "idle"]
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
    made = make_table(study, "main", partial=True)
    assert made.columns == ("system", "Color", "mean", "score")
    assert [cells[0] for cells in made.texts] == ["expert", "idle"]
    (failure,) = (one.failure for one in plan_study(study).cells if one.failure)
    assert "; ".join(made.notes).endswith(f"broken · short is missing: {failure.reason}")
    assert made.is_partial
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
    found = json.loads(run.invoke(app, ["study", "table", str(file), "light", "--format", "json"]).stdout)
    assert [(one["category"], one["items"], one["of_items"]) for one in found["numbers"]] == [
        ("color", 2, 2),
        ("mean", 2, 2),
    ]


@pytest.mark.slow
def test_a_file_that_asks_for_more_items_plays_the_missing_ones_alone(file: Path) -> None:
    conduct_study(plan_study(load_study(file)), env_workers=0)
    more = file.with_name("more.toml")
    more.write_text(file.read_text(encoding="utf-8").replace("items = 2", "items = 4"), encoding="utf-8")
    assert states(more)["expert/short"] == ("partial", 4)
    place = Path(
        next(one.location for one in plan_study(load_study(more)).cells if one.cell.name == "expert/short")
    )
    before = {path.name: path.read_bytes() for path in (place / "commits").iterdir()}
    conduct_study(plan_study(load_study(more), only="expert"), env_workers=0)
    assert states(more)["expert/short"] == ("whole", 8)
    assert states(file)["expert/short"] == ("whole", 4)  # more than what it needs
    after = {path.name: path.read_bytes() for path in (place / "commits").iterdir()}
    assert len(after) == 8
    assert {name: after[name] for name in before} == before
    shown = {one["system"]: one["items"] for one in make_table(load_study(file), "main", partial=True).numbers}
    assert shown["expert"] == 2


@pytest.mark.slow
def test_every_scene_is_built_before_the_first_run_is_played(file: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.png"
    torn.write_text("no picture", encoding="utf-8")
    text = file.read_text(encoding="utf-8").replace(str(load_study(file).study.folder), str(tmp_path / "out"))
    changed = tmp_path / "study.toml"
    scene = f'rendering = "visual-matching"\nbackground = "{torn}"'
    changed.write_text(text.replace("light_level = 0.7", scene), encoding="utf-8")
    told: list[object] = []
    failures = conduct_study(plan_study(load_study(changed)), told.append, env_workers=0)
    assert [(one.stage, one.run) for one in failures] == [("checking", "broken/short"), ("checking", "idle/dark")]
    assert [type(one).__name__ for one in told][:3] == ["Failure", "Failure", "Moved"]
    assert states(changed)["idle/short"] == ("waiting", 0)
    assert states(changed)["expert/short"] == ("whole", 4)
    changed.write_text(text, encoding="utf-8")  # what failed before it played is tried again unasked
    conduct_study(plan_study(load_study(changed)), env_workers=0)
    assert states(changed)["idle/short"] == states(changed)["idle/dark"] == ("whole", 4)


@pytest.mark.slow
def test_what_fails_while_it_plays_is_kept_with_its_traceback_and_tried_again_on_request(
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

    def count(family, *given, **options):  # type: ignore[no-untyped-def]
        loaded.append(family)
        return load_policy(family, *given, **options)

    monkeypatch.setattr("probe_kit.hooks.load_policy", count)
    text = TEXT.replace('family = "idle"', 'family = "pi0-tiny"\nrandom_weights = true')
    file = small_study(tmp_path, small_suite, text, items=2)
    assert [one.model for one in conduct_study(plan_study(load_study(file)), env_workers=0)] == ["broken"]
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
    made = make_table(study, "probing", partial=True)
    assert [cells[:3] for cells in made.texts] == [
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
