"""Archives of a study: every table from the archive alone, and nothing that was left out by mistake."""

import json
from pathlib import Path
from shutil import copytree, rmtree
from zipfile import ZipFile

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import NoTrajectoryError, RunDamagedError, UsageError
from probe_kit.retention import retention_table
from probe_kit.runs import copy_run, open_run, verify_run
from probe_kit.study import LoadedStudy, load_study, make_table, pack_study, plan_study
from probe_kit.study.archive import table_of_record, table_record


@pytest.fixture(scope="module")
def archive(played: LoadedStudy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("packed") / "study.zip"
    pack_study(played, out)
    return out


def test_every_table_is_the_same_from_the_archive_alone(
    played: LoadedStudy, archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither runs nor suite are where they were."""
    before = {name: make_table(played, name) for name in played.study.tables}
    home = Path(played.study.folder)
    away = tmp_path / "away"
    home.rename(away)
    monkeypatch.setattr("probe_kit.study.reading.planned_suite", None)
    try:
        packed = load_study(archive)
        assert {name: make_table(packed, name) for name in packed.study.tables} == before
        assert {one.state for one in plan_study(packed).cells} == {"whole"}
    finally:
        away.rename(home)


def test_an_archive_holds_no_picture_no_activation_and_no_name_of_this_machine(
    played: LoadedStudy, archive: Path
) -> None:
    with ZipFile(archive) as packed:
        names = packed.namelist()
    assert not [name for name in names if name.endswith((".png", ".jpg", ".gif", ".mp4"))]
    assert not [name for name in names if "/c/" in name and "/data.zarr/" in name and "pooled" in name]
    assert {name.split("/")[0] for name in names} == {"study.toml", "pack.json", "runs", "tables", "SHA256SUMS"}
    assert not [name for name in names if "/trajectory/c/" in name]
    assert {f"tables/{name}.{end}" for name in played.study.tables for end in ("json", "md", "tex")} <= set(names)


def test_the_same_study_gives_the_same_bytes(played: LoadedStudy, archive: Path, tmp_path: Path) -> None:
    pack_study(played, tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == archive.read_bytes()


def test_an_archive_without_trajectories_judges_by_their_absence_and_with_them_as_before(
    played: LoadedStudy, archive: Path, tmp_path: Path
) -> None:
    pack_study(played, tmp_path / "pack", extras=["trajectories"])
    rates = []
    for study in (played, load_study(tmp_path / "pack")):
        run = open_run(study.cells[0].location(study.study.folder))
        rates.append(retention_table([run], rule="box").means[0].success.sr)
    assert rates[0] == rates[1] is not None
    bare = load_study(archive)
    run = open_run(bare.cells[0].location(bare.study.folder))
    assert verify_run(run.location, deep=True).ok
    assert retention_table([run], rule="box").means[0].success.sr is None
    with pytest.raises(NoTrajectoryError, match="is a copy without them"):
        run.trajectory(0)


def test_what_was_changed_or_lost_is_named(played: LoadedStudy, tmp_path: Path) -> None:
    folder = tmp_path / "pack"
    pack_study(played, folder)
    changed = copytree(folder, tmp_path / "changed")
    (changed / "tables" / "main.md").write_text("other", encoding="utf-8")
    with pytest.raises(RunDamagedError, match=r"main\.md has other bytes than were packed"):
        load_study(changed)
    more = copytree(folder, tmp_path / "more")
    (more / "runs" / "added.json").touch()
    with pytest.raises(RunDamagedError, match=r"added\.json was not packed"):
        load_study(more)
    lost = copytree(folder, tmp_path / "lost")
    rmtree(lost / "runs" / "idle")
    with pytest.raises(RunDamagedError, match=r"runs/idle/.* is missing\. Fetch the archive again"):
        load_study(lost)
    with pytest.raises(UsageError, match="exists; choose another --out"):
        pack_study(played, folder)
    (tmp_path / "broken.zip").write_bytes(b"PK no zip")
    with pytest.raises(RunDamagedError, match="no whole zip file"):
        load_study(tmp_path / "broken.zip")


def test_missing_runs_are_refused_or_named(played: LoadedStudy, tmp_path: Path) -> None:
    file = tmp_path / "more.toml"
    text = played.file.read_text(encoding="utf-8").replace("light_level = 0.7", "light_level = 0.6")
    file.write_text(text, encoding="utf-8")
    run = CliRunner()
    refused = run.invoke(app, ["study", "pack", str(file), "--out", str(tmp_path / "a.zip")])
    assert refused.exit_code != 0
    assert not (tmp_path / "a.zip").exists()
    made = run.invoke(app, ["study", "pack", str(file), "--out", str(tmp_path / "a.zip"), "--partial"])
    assert made.exit_code == 0, made.output
    assert "2 runs, without activations, pictures, trajectories, directions" in made.stdout
    assert "not packed: idle/dark: " in made.stdout
    assert run.invoke(app, ["study", "table", str(tmp_path / "a.zip"), "main"]).exit_code == 0
    assert run.invoke(app, ["study", "run", str(tmp_path / "a.zip")]).exit_code == 2


def test_a_table_is_the_same_after_its_record(played: LoadedStudy) -> None:
    made = make_table(played, "score")
    again = table_of_record(json.loads(json.dumps(table_record(made))))
    assert again.to_markdown() == made.to_markdown()
    assert json.dumps(again.numbers) == json.dumps(made.numbers)


def test_a_run_is_whole_without_what_an_archive_leaves_out(little_runs: Path, tmp_path: Path) -> None:
    """With probes, whose directions stay behind as activations do."""
    copy = tmp_path / "copy"
    copy_run(little_runs / "run", copy, directions=False)
    names = {path.name for path in copy.rglob("*") if "probes" in path.parts}
    assert any("settings" in name for name in names)
    assert not any("directions" in name for name in names)
    audit = verify_run(copy, deep=True)
    assert (audit.problems, audit.committed) == ((), audit.planned)
    answer = CliRunner().invoke(app, ["run", "verify", str(copy), "--deep"])
    assert (answer.exit_code, answer.exception) == (0, None), answer.stderr
    (probed,) = [path for path in copy.rglob("*") if "scores" in path.name and "probes" in path.parts][:1]
    probed.write_bytes(b"")
    assert verify_run(copy, deep=True).problems
