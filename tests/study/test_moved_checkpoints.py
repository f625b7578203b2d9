"""Runs of local checkpoints belong to models by content, wherever its files lie, and without them."""

import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import probe_kit.models.checkpoints
from probe_kit.errors import RunDamagedError, RunIncompleteError, SettingsMismatchError
from probe_kit.extract import ExtractSettings
from probe_kit.runs import Run
from probe_kit.runs.layout import RUN_FILE
from probe_kit.runs.store import locate
from probe_kit.study import conduct_study, file_contents, load_study, make_table, pack_study, plan_study
from probe_kit.study.cells import PlannedRun, planned_suite
from probe_kit.study.file_contents import content_of, former_stamp
from probe_kit.study.schema import SuiteTable
from probe_kit.study.study_folder import RECORDS, PlayedModel, StudyFolder
from probe_kit.suite import Suite
from tests.study.small_study import HEAD

TEXT = """
[models.late]
family = "pi0-tiny"
checkpoint = "{late}"

[models.early]
family = "pi0-tiny"
checkpoint = "{early}"

[models.random]
family = "pi0-tiny"
random_weights = true

[conditions.plain]
max_steps = 1

[conditions.dark]
max_steps = 1
light_level = 0.7

[[runs]]
name = "main"
models = ["late", "early", "random"]
conditions = ["plain"]
seeds = [0, 1]

[[runs]]
name = "light"
models = ["late"]
conditions = ["dark"]

[tables.main]
kind = "sides"
runs = ["main", "light"]
"""
CHECKPOINTS = ("late", "early")


def write_file(folder: Path, suite: Suite, checkpoints: Path) -> Path:
    paths = {name: str(checkpoints / name) for name in CHECKPOINTS}
    text = (HEAD + TEXT).format(out=folder / "out", suite=suite.folder, items=2, **paths)
    file = folder / "study.toml"
    file.write_text(text, encoding="utf-8")
    return file


def copy_embedded(folder: Path) -> None:
    embedded = Path(next(iter(probe_kit.models.checkpoints.__path__)))
    for name, source in zip(CHECKPOINTS, ("pi0-tiny", "pi0-tiny-early"), strict=True):
        shutil.copytree(embedded / source, folder / name)


# -- the content of files ----------------------------------------------------------------------------------------


def files_in(folder: Path) -> Path:
    (folder / "parts").mkdir(parents=True)
    (folder / "parts" / "model.safetensors").write_bytes(b"weights")
    (folder / "config.json").write_bytes(b"{}")
    return folder


def overwrite(file: Path, content: bytes) -> None:
    """Write other bytes of the same length at the same time of modification."""
    stat = file.stat()
    assert len(content) == stat.st_size
    file.write_bytes(content)
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def test_content_is_of_names_and_bytes_and_of_no_time_and_no_place(tmp_path: Path) -> None:
    folder = files_in(tmp_path / "first")
    before, stamp = content_of(folder), former_stamp(str(folder))
    copied = Path(shutil.copytree(folder, tmp_path / "copied", copy_function=shutil.copyfile))
    os.utime(copied / "config.json", ns=(0, 0))
    (copied / ".cache").mkdir()
    (copied / ".cache" / "download.metadata").write_text("today", encoding="utf-8")
    (tmp_path / "linked").symlink_to(copied)
    assert content_of(copied) == content_of(tmp_path / "linked") == content_of(str(folder)) == before
    assert former_stamp(str(copied)) != stamp
    file = Path(shutil.copy(folder / "config.json", tmp_path / "renamed.json"))
    assert content_of(file) == content_of(folder / "config.json") != before


@pytest.mark.parametrize("is_cached", [False, True])
@pytest.mark.parametrize(
    "change",
    [
        lambda folder: overwrite(folder / "parts" / "model.safetensors", b"retrain"),
        lambda folder: (folder / "config.json").rename(folder / "settings.json"),
        lambda folder: (folder / "parts").rename(folder / "pieces"),
        lambda folder: (folder / "parts" / "more.safetensors").touch(),
        lambda folder: (folder / "config.json").unlink(),
    ],
    ids=["bytes of equal size and time", "name", "name of a folder", "file more", "file less"],
)
def test_every_change_of_a_name_or_a_byte_is_another_content(
    change: Callable[[Path], object], is_cached: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path / "cache"))
    if is_cached:  # files are too new otherwise
        monkeypatch.setattr(file_contents, "_SETTLED_NS", -(10**15))
    folder = files_in(tmp_path / "files")
    before = content_of(folder)
    assert content_of(folder) == before
    assert len(list(tmp_path.glob("cache/*/*.json"))) == 2 * is_cached
    change(folder)
    assert content_of(folder) not in (before, None)


def test_a_large_file_is_read_once_and_that_is_announced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(file_contents, "_SETTLED_NS", -(10**15))
    monkeypatch.setattr(file_contents, "LONG_READ", 5)
    folder = files_in(tmp_path / "files")
    contents = [content_of(folder), content_of(folder)]
    assert " ".join(capsys.readouterr().err.split()).count("once: a run is known by the content") == 1
    for entry in tmp_path.glob("cache/*/*.json"):
        entry.write_text("[", encoding="utf-8")
    assert {*contents, content_of(folder)} == {contents[0]}


def test_a_missing_checkpoint_has_no_content_hash(tmp_path: Path) -> None:
    (tmp_path / "mount").mkdir()
    (tmp_path / "mount" / ".hidden").touch()
    assert [content_of(tmp_path / name) for name in ("mount", "nothing")] == [None, None]
    assert content_of("~nobody-of-this-name/weights") is None


# -- keys --------------------------------------------------------------------------------------------------------


def keys(file: Path) -> dict[str, str]:
    return {cell.name: cell.key for cell in load_study(file).cells}


def note(file: Path, when: str) -> None:
    """Write the records of a study as if it had been played; a run is there if it has a `run.json`."""
    study = load_study(file)
    out = Path(study.study.folder)
    (out / RECORDS).mkdir(parents=True, exist_ok=True)
    for cell in study.cells:
        assert study.home is not None
        model = PlayedModel(
            run=cell.folder, model=cell.model, asks=False, paths=cell.paths, contents=study.home.contents(cell),
            weights_sha256="0" * 64, policy={}, when=when,
        )  # fmt: skip
        (out / RECORDS / f"{cell.folder.replace('/', '+')}.json").write_bytes(model.to_bytes())
        (out / cell.folder).mkdir(parents=True, exist_ok=True)
        (out / cell.folder / RUN_FILE).touch()


def test_a_run_has_one_name_with_and_without_the_files_of_its_checkpoint(
    small_suite: Suite, tmp_path: Path
) -> None:
    for name in CHECKPOINTS:
        files_in(tmp_path / name)
    overwrite(tmp_path / "early" / "config.json", b"[]")
    file = write_file(tmp_path, small_suite, tmp_path)
    before = keys(file)
    assert len(set(before.values())) == len(before)
    note(file, "2026-01-01")
    (tmp_path / "away").mkdir()
    for name in CHECKPOINTS:
        (tmp_path / name).rename(tmp_path / "away" / name)
    assert keys(file) == before
    assert keys(write_file(tmp_path, small_suite, tmp_path / "away")) == before
    unknown = keys(write_file(tmp_path, small_suite, tmp_path / "elsewhere"))
    state = {planned.cell.name: planned.why for planned in plan_study(load_study(file)).cells}["late/dark"]
    paths = f"{tmp_path / 'elsewhere' / 'late'} is not here, .*; runs of late were played from {tmp_path / 'late'}"
    assert re.match(f"new: the checkpoint {paths}$", state)
    assert {name for name in before if unknown[name] == before[name]} == {
        "random/plain",
        "random/plain/seed 1",
    }


def test_of_two_contents_of_one_path_the_last_one_counts_without_the_files(
    small_suite: Suite, tmp_path: Path
) -> None:
    for name in CHECKPOINTS:
        files_in(tmp_path / name)
    file, names = write_file(tmp_path, small_suite, tmp_path), list[dict[str, str]]()
    for at, content in enumerate((b"first  ", b"second ")):
        overwrite(tmp_path / "late" / "parts" / "model.safetensors", content)
        names.append(keys(file))
        note(file, f"2026-01-0{at + 1}")
    assert {name for name in names[0] if names[0][name] != names[1][name]} == {
        "late/plain", "late/plain/seed 1", "late/dark",
    }  # fmt: skip
    shutil.rmtree(tmp_path / "late")
    assert keys(file) == names[1]
    record = next((tmp_path / "out" / RECORDS).glob("late+dark-*.json"))
    record.write_bytes(record.read_bytes().replace(b"2026-01-0", b"2025-01-0"))
    with pytest.raises(RunDamagedError, match=r"was changed after it was written: .*or delete it"):
        keys(file)


def test_a_file_that_an_option_names_counts_by_content_too(small_suite: Suite, tmp_path: Path) -> None:
    suite = planned_suite(SuiteTable(path=str(small_suite.folder)))[0]

    def key(checkpoint: str, tokenizer: str) -> str:
        settings = ExtractSettings("magma", checkpoint, options={"tokenizer": tokenizer})
        return PlannedRun(
            "m", "plain", 0, settings, {}, suite, find_key=StudyFolder(str(tmp_path / "out")).key
        ).key

    first, other = files_in(tmp_path / "first"), files_in(tmp_path / "other")
    weights = files_in(tmp_path / "weights")
    assert key(str(weights), str(first)) == key(str(weights), str(other)) == key(str(first), str(weights))
    assert key("lab/weights", str(first)) == key("lab/weights", str(other)) != key("lab/others", str(first))
    overwrite(other / "config.json", b"[]")
    of_names = {key(*names) for names in (("lab/weights", str(first)), ("lab/weights", str(other)))}
    assert len(of_names | {key(str(weights), str(other)), key(str(other), str(weights))}) == 4


# -- played runs -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def played_file(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("moved")
    copy_embedded(folder)
    file = write_file(folder, small_suite, folder)
    assert conduct_study(plan_study(load_study(file)), env_workers=0) == []
    return file


@pytest.fixture
def file(played_file: Path, tmp_path: Path, small_suite: Suite) -> Path:
    """A copy of the played study, times kept, whose checkpoints lie where they were."""
    shutil.copytree(played_file.parent / "out", tmp_path / "out")
    return write_file(tmp_path, small_suite, played_file.parent)


@pytest.fixture
def away(played_file: Path) -> Iterator[Path]:
    """Their folder after the checkpoints are moved there; they come back after the test."""
    folder = played_file.parent / "away"
    folder.mkdir()
    for name in CHECKPOINTS:
        (played_file.parent / name).rename(folder / name)
    yield folder
    for name in CHECKPOINTS:
        (folder / name).rename(played_file.parent / name)
    folder.rmdir()


def rows(file: Path) -> object:
    return make_table(load_study(file), "main").texts


def exchange(file: Path, name: str, other: str) -> None:
    study = load_study(file)
    folders = [Path(cell.location(study.study.folder)) for cell in study.cells if cell.name in (name, other)]
    aside = folders[0].with_name("aside")
    for source, target in ((folders[0], aside), (folders[1], folders[0]), (aside, folders[1])):
        source.rename(target)


def states(file: Path) -> set[str]:
    return {planned.state for planned in plan_study(load_study(file)).cells}


@pytest.mark.slow
def test_tables_plans_and_archives_need_no_file_of_a_checkpoint(
    file: Path, away: Path, small_suite: Suite, tmp_path: Path
) -> None:
    absent = rows(file)
    assert states(file) == {"whole"}
    archive = tmp_path / "study.zip"
    pack_study(load_study(file), archive)
    assert rows(archive) == absent
    write_file(tmp_path, small_suite, away)
    assert rows(file) == absent
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert conduct_study(plan_study(load_study(file)), env_workers=0) == []
    assert {path: path.stat().st_mtime_ns for path in before} == before
    write_file(tmp_path, small_suite, away.parent)
    assert rows(file) == absent  # the former paths are known too
    copied = tmp_path / "copied"
    shutil.copytree(away, copied, copy_function=shutil.copyfile)
    write_file(tmp_path, small_suite, copied)
    assert rows(file) == absent
    weights = (copied / "late" / "model.safetensors").read_bytes()
    overwrite(copied / "late" / "model.safetensors", weights[:-1] + bytes([weights[-1] ^ 1]))
    assert states(file) == {"whole", "new"}  # trained in place: another run
    with pytest.raises(RunIncompleteError, match="late/plain is not whole"):
        rows(file)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["old", "away", "absent"])
@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("late/plain", "early/plain"),
        ("late/plain", "late/plain/seed 1"),
        ("late/plain", "late/dark"),
        ("early/plain", "random/plain"),
    ],
)
def test_a_run_in_the_folder_of_another_one_is_refused_wherever_checkpoints_lie(
    name: str, other: str, where: str, file: Path, small_suite: Suite, request: pytest.FixtureRequest
) -> None:
    before = rows(file)
    if where != "old":
        folder = request.getfixturevalue("away")
        if where == "away":
            write_file(file.parent, small_suite, folder)
    exchange(file, name, other)
    with pytest.raises(SettingsMismatchError, match=f"should hold the run of {name}.* It is a run of {other}"):
        rows(file)
    assert states(file) == {"whole", "damaged"}
    with pytest.raises(SettingsMismatchError):
        pack_study(load_study(file), file.parent / "study.zip", partial=True)
    exchange(file, name, other)
    assert rows(file) == before


@pytest.mark.slow
@pytest.mark.parametrize("is_here", [True, False])
def test_runs_of_an_earlier_version_are_those_that_were_loaded_from_the_same_path(
    is_here: bool, file: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, study = rows(file), load_study(file)
    shutil.rmtree(file.parent / "out" / RECORDS)
    for cell in study.cells:
        if (checkpoint := cell.settings.model.checkpoint) is not None:
            former = cell.folder_of(cell.key_with({"checkpoint": former_stamp(checkpoint)}))
            Path(cell.location(study.study.folder)).rename(file.parent / "out" / former)
    if is_here:
        assert conduct_study(plan_study(load_study(file)), env_workers=0) == []
        assert len(list((file.parent / "out" / RECORDS).iterdir())) == 5
    request.getfixturevalue("away")
    assert rows(file) == before
    late, early = (next((file.parent / "out" / name).glob("plain-????????")) for name in CHECKPOINTS)
    shutil.copytree(early, late.with_name("plain-00000000"))  # which was loaded from another path
    assert rows(file) == before
    shutil.copytree(late, late.with_name("plain-00000001"))
    assert rows(file) == before
    if not is_here:
        monkeypatch.setattr(Run, "weights_sha256", property(lambda run: run.location.name))
        with pytest.raises(SettingsMismatchError, match=r"2 different weights, all loaded from .*late, which"):
            rows(file)


@pytest.mark.slow
def test_a_study_in_a_bucket_is_read_without_checkpoints_and_notices_exchanged_runs(
    file: Path, away: Path, bucket: str
) -> None:
    before, out, text = rows(file), file.parent / "out", file.read_text(encoding="utf-8")
    assert away.is_dir()
    late, early = (next((out / name).glob("plain-????????")).relative_to(out).as_posix() for name in CHECKPOINTS)
    for url, names in ((f"{bucket}/right", {}), (f"{bucket}/wrong", {late: early, early: late})):
        for path in filter(Path.is_file, out.rglob("*")):
            key = path.relative_to(out).as_posix()
            run = "/".join(key.split("/")[:2])
            locate(url).write(f"{names.get(run, run)}{key.removeprefix(run)}", path.read_bytes())
    file.write_text(text.replace(str(out), f"{bucket}/right"), encoding="utf-8")
    assert rows(file) == before
    file.write_text(text.replace(str(out), f"{bucket}/wrong"), encoding="utf-8")
    with pytest.raises(
        SettingsMismatchError, match=r"should hold the run of late/plain.* It is a run of early/plain"
    ):
        rows(file)


@pytest.mark.slow
def test_a_checkpoint_that_changes_while_it_is_played_is_said(small_suite: Suite, tmp_path: Path) -> None:
    copy_embedded(tmp_path)
    file = write_file(tmp_path, small_suite, tmp_path)

    def train_on(event: object) -> None:
        readme = tmp_path / "early" / "trained.md"
        if not readme.exists() and getattr(event, "run", "") == "late/plain":
            readme.write_text("one step more", encoding="utf-8")

    failures = conduct_study(plan_study(load_study(file), only="main"), train_on, env_workers=0)
    assert [failure.run for failure in failures] == ["early/plain", "early/plain/seed 1"]
    assert "early was changed while early/plain was played" in failures[0].reason
    assert {planned.state for planned in plan_study(load_study(file), only="early").cells} == {"new"}
