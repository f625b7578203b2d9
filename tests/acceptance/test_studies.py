"""A study of one file: planned, played, resumed, shown as tables and figures, packed and read from the archive."""

import json
import re
import shutil
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
from PIL import Image

import probe_kit as pk
from tests.acceptance.product import probe_kit

STUDY = """
schema = 1
name = "scripted"
out = "{out}"

[suite]
categories = ["color"]
items = 2

[models.expert]
family = "expert"

[models.idle]
family = "idle"
label = "Idle"

[conditions.usual]
max_steps = 30

[conditions.short]
max_steps = 1

[[runs]]
name = "main"
models = ["expert", "idle"]
conditions = ["usual"]

[[runs]]
name = "cut"
models = ["expert"]
conditions = ["short"]

[comparisons.time]
pairs = {{ conditions = ["usual", "short"], models = ["expert"] }}

[tables.main]
kind = "success"
runs = ["main"]

[tables.time]
kind = "ablation"
comparison = "time"

[figures.overview]
kind = "overview"
runs = ["main"]
"""


def write_study(folder: Path, text: str = STUDY) -> Path:
    folder.mkdir(exist_ok=True)
    file = folder / "study.toml"
    file.write_text(text.format(out=(folder / "runs").as_posix()), encoding="utf-8")
    return file


def stored(folder: Path) -> dict[str, int]:
    """Time of writing of every committed episode below a folder."""
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("commits/*.json")}


def play(folder: Path) -> Path:
    """Play one model of the study, then all of it."""
    file = write_study(folder)
    probe_kit("study", "run", file, "--only", "idle", "--env-workers", "0")
    first = stored(folder)
    assert len(first) == 4, "two items in both layouts"
    assert probe_kit("study", "run", file, "--dry-run", "--exit-code", code=1).text
    probe_kit("study", "run", file, "--env-workers", "0")
    assert first.items() <= stored(folder).items(), "what was stored is played again"
    return file


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a study whose runs are stored: played in part first, then resumed."""
    return play(tmp_path_factory.mktemp("study") / "one")


def test_a_dry_run_prints_the_plan_and_writes_nothing(tmp_path: Path) -> None:
    file = write_study(tmp_path / "planned")
    plan = probe_kit("study", "run", file, "--dry-run", "--json").json()
    text = probe_kit("study", "run", file, "--dry-run").text
    assert [path.name for path in file.parent.iterdir()] == ["study.toml"]
    assert all(name in text for name in ("expert", "short"))
    assert re.search(r"\b12\b", json.dumps(plan)), "three runs of four episodes"
    assert probe_kit("study", "run", file, "--dry-run", "--exit-code", code=1).text


def test_a_study_resumes_and_a_whole_one_plays_nothing(study: Path) -> None:
    before = stored(study.parent)
    assert len(before) == 12
    probe_kit("study", "run", study, "--env-workers", "0")
    assert stored(study.parent) == before
    typed = ("study", "run", study, "--dry-run", "--exit-code", "--verify")
    assert "whole" in probe_kit(*typed).text


def rates(study: Path) -> dict[str, float]:
    """Success rates of the plain condition by model, from the runs themselves."""
    runs = [pk.open_run(path.parent) for path in study.parent.rglob("run.json") if "usual" in str(path)]
    return {run.model: float((run.episodes["outcome"] == "correct").mean()) for run in runs}


def test_a_table_holds_the_success_of_the_runs_in_every_format(study: Path) -> None:
    expected = rates(study)
    assert expected == {"expert": 1.0, "idle": 0.0}
    held = json.dumps(probe_kit("study", "table", study, "main", "--format", "json").json())
    for style in ("table", "markdown", "latex"):
        text = probe_kit("study", "table", study, "main", "--format", style).out
        for name, rate in (("expert", 100), ("Idle", 0)):
            line = next(line for line in text.splitlines() if name in line)
            first = re.search(r"-?\d+(?:\.\d+)?", line.replace("−", "-").partition(name)[2])
            assert first is not None, text
            assert float(first.group()) == rate, text
    assert all(name in held for name in ("expert", "Idle", "color"))
    both = probe_kit("study", "table", study).out
    assert "expert" in both
    assert "short" in both
    answer = probe_kit("study", "table", study, "nothing", code=2)
    assert "time" in answer.text, "the names that exist"


def test_an_ablation_subtracts_one_condition_from_another_on_the_same_items(study: Path) -> None:
    """The expert needs more than one action: all of its success is lost."""
    held = probe_kit("study", "table", study, "time", "--format", "json").json()
    numbers = {abs(value) for value in numeric_leaves(held["numbers"])}
    assert numbers & {1.0, 100.0}
    text = probe_kit("study", "table", study, "time", "--format", "markdown").out.replace("−", "-")
    row = next(line for line in text.splitlines() if line.startswith("|") and "expert" in line)
    assert re.search(r"[-+]100(?:\.0)?\b", row), text


def numeric_leaves(value: Any) -> list[float]:
    """All numbers of a nested JSON value."""
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return []
    if isinstance(value, int | float):
        return [float(value)]
    return [
        number
        for part in (value.values() if isinstance(value, dict) else value)
        for number in numeric_leaves(part)
    ]


def test_figures_are_drawn_as_png_and_pdf(study: Path, tmp_path: Path) -> None:
    probe_kit("study", "figure", study, "overview", "--out", tmp_path / "figures")
    (png,) = (tmp_path / "figures").glob("*.png")
    (pdf,) = (tmp_path / "figures").glob("*.pdf")
    with Image.open(png) as picture:
        picture.load()
        assert min(picture.size) > 200
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 2
    assert pdf.read_bytes().startswith(b"%PDF")


def test_the_report_of_a_study_is_one_file_with_its_tables(study: Path, tmp_path: Path) -> None:
    probe_kit("study", "table", study, "--html", tmp_path / "report.html")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert all(name in text for name in ("expert", "Idle", "max_steps"))
    assert not re.search(r"""(?:src|href)=["']https?:""", text)


def test_an_archive_gives_every_table_without_the_runs_and_refuses_a_changed_file(
    study: Path, tmp_path: Path
) -> None:
    archive = tmp_path / "study.zip"
    before = {name: probe_kit("study", "table", study, name).out for name in ("main", "time")}
    probe_kit("study", "pack", study, "--out", archive)
    away = study.parent.with_name("away")
    study.parent.rename(away)
    try:
        assert {name: probe_kit("study", "table", archive, name).out for name in before} == before
    finally:
        away.rename(study.parent)
    probe_kit("study", "run", archive, code=2)
    names = ZipFile(archive).namelist()
    assert "SHA256SUMS" in names
    assert not [name for name in names if name.endswith((".png", ".webp"))]
    folder = tmp_path / "unpacked"
    with ZipFile(archive) as packed:
        packed.extractall(folder)
    lost = Path(shutil.copytree(folder, tmp_path / "lost"))
    changed = next(path for path in folder.rglob("commits/*.json"))
    changed.write_bytes(changed.read_bytes().replace(b"0", b"1", 1))
    next(lost.rglob("commits/*.json")).unlink()
    for broken in (folder, lost):
        assert "RunDamagedError" in probe_kit("study", "table", broken, "main", code=1).err


def test_mistakes_of_a_file_are_reported_together_before_anything_is_played(tmp_path: Path) -> None:
    text = STUDY.replace('family = "idle"', 'family = "idel"').replace('runs = ["main"]', 'runs = ["mian"]', 1)
    file = write_study(tmp_path / "wrong", text)
    answer = probe_kit("study", "run", file, code=2)
    assert "idel" in answer.text
    assert "mian" in answer.text
    assert "idle" in answer.text.replace("idel", ""), "the nearest name"
    assert [path.name for path in file.parent.iterdir()] == ["study.toml"]


def test_a_table_of_runs_that_are_missing_is_refused_and_partial_names_them(tmp_path: Path, study: Path) -> None:
    file = Path(shutil.copy(study, tmp_path / "more.toml"))
    file.write_text(
        study.read_text(encoding="utf-8").replace("max_steps = 1\n", "max_steps = 2\n"), encoding="utf-8"
    )
    refused = probe_kit("study", "table", file, "time", code=None)
    assert refused.code in (1, 2)
    assert "short" in refused.text
    partial = probe_kit("study", "table", file, "--partial", code=1)
    assert "expert" in partial.out
    assert "short" in partial.text


@pytest.mark.slow
def test_the_study_of_the_package_plays_and_every_table_of_it_has_numbers(tmp_path: Path) -> None:
    plan = probe_kit("study", "run", "embedded", "--dry-run").text
    assert all(name in plan for name in ("base", "main", "192", "7,680")), plan
    text = """
    schema = 1
    name = "probed"
    out = "{out}"
    [suite]
    categories = ["color"]
    items = 12
    [models.base]
    family = "pi0-tiny"
    vlm = "reader"
    finetuned_from = "early"
    untrained = "untrained"
    groups = ["after"]
    [models.early]
    family = "pi0-tiny-early"
    untrained = "untrained-early"
    groups = ["before"]
    [models.untrained]
    family = "pi0-tiny"
    random_weights = true
    [models.untrained-early]
    family = "pi0-tiny-early"
    random_weights = true
    [models.reader]
    family = "vlm-tiny"
    [conditions.short]
    max_steps = 6
    [conditions.still]
    no_act = true
    max_steps = 6
    [asks.p1]
    prompt = "p1"
    [[runs]]
    name = "main"
    models = ["base", "early"]
    conditions = ["short"]
    [[runs]]
    name = "controls"
    models = ["untrained", "untrained-early"]
    conditions = ["still"]
    [[runs]]
    name = "vlms"
    models = ["reader"]
    asks = ["p1"]
    [probes.main]
    runs = ["main"]
    views = ["mean"]
    permutations = 19
    controls = ["untrained"]
    [comparisons.tuning]
    chain = ["early", "base"]
    [drift.training]
    pairs = [["early", "base"]]
    view = "mean"
    [tables.tuning]
    kind = "chain"
    comparison = "tuning"
    [tables.probing]
    kind = "probing"
    runs = ["main"]
    [tables.vlm-vla]
    kind = "vlm-vla"
    runs = ["main", "vlms"]
    [tables.stages]
    kind = "stages"
    runs = ["main", "vlms"]
    [tables.drift]
    kind = "drift"
    drift = "training"
    [tables.sides]
    kind = "sides"
    runs = ["main"]
    [tables.score]
    kind = "score"
    runs = ["main"]
    [figures.curves]
    kind = "curves"
    runs = ["main"]
    """
    file = write_study(tmp_path / "probed", text)
    probe_kit("study", "run", file, "--env-workers", "0")
    for name in ("tuning", "probing", "vlm-vla", "stages", "drift", "sides", "score"):
        numbers = json.dumps(probe_kit("study", "table", file, name, "--format", "json").json())
        assert re.search(r"\d\.\d", numbers), name
        assert re.search(r"\d", probe_kit("study", "table", file, name).out), name
    probe_kit("study", "figure", file, "curves", "--out", tmp_path / "figures")
    assert list((tmp_path / "figures").glob("*.png"))
