"""Random changes of a study folder and of an archive: a table prints the same numbers, or an error."""

import json
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from probe_kit.errors import ProbeKitError
from probe_kit.study import (
    LoadedStudy,
    conduct_study,
    fit_probes,
    load_study,
    make_table,
    pack_study,
    plan_study,
)
from probe_kit.study.archive import table_record
from probe_kit.suite import Suite
from tests.study.small_study import small_study

FEW, MANY = 15, 300
Undo = Callable[[], object]


def tables_of(name: Path) -> str:
    """Every table of a study file or archive, with all its numbers."""
    study = load_study(name)
    return json.dumps({table: table_record(make_table(study, table)) for table in study.study.tables})


def verdict(name: Path, before: str) -> str:
    try:
        after = tables_of(name)
    except ProbeKitError:
        return "error"
    except Exception as error:  # noqa: BLE001 - any other error would be a traceback
        return f"TRACEBACK {type(error).__name__}: {error}"
    return "same" if after == before else "SILENT"


# -- changes of a folder -----------------------------------------------------------------------------------


def put(file: Path, content: bytes) -> Undo:
    before = file.read_bytes() if file.is_file() else None
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content)
    return (lambda: file.unlink()) if before is None else lambda: file.write_bytes(before)


def move(source: Path, target: Path) -> Undo:
    target.parent.mkdir(parents=True, exist_ok=True)
    source.rename(target)
    return lambda: target.rename(source)


def exchange(first: Path, other: Path) -> Undo:
    aside = first.with_name("aside.exchanged")

    def swap() -> None:
        first.rename(aside)
        other.rename(first)
        aside.rename(other)

    swap()
    return swap


def files_below(folder: Path) -> list[Path]:
    """One file of each kind as often as any other, so that the many objects of arrays do not hide records."""
    kinds: dict[str, list[Path]] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            parts = path.relative_to(folder).parts
            kinds.setdefault("/".join((*parts[:1], *parts[2:3], path.suffix)), []).append(path)
    most = max(map(len, kinds.values()))
    return [path for paths in kinds.values() for path in (paths * (most // len(paths)))[:most]]


def folders_below(folder: Path) -> list[Path]:
    return [
        path for path in sorted(folder.rglob("*")) if path.is_dir() and "c" not in path.relative_to(folder).parts
    ]


def change(folder: Path, draw: Random) -> tuple[str, Undo]:
    """One random change below a folder, in words, and how it is undone."""
    files, folders = files_below(folder), folders_below(folder)
    file, kind = draw.choice(files), draw.randrange(11)
    content = file.read_bytes()
    alike = [path for path in files if path.suffix == file.suffix and path != file]
    other = draw.choice(alike or [path for path in files if path != file])
    if kind == 0 and content:
        at = draw.randrange(len(content))
        changed = content[:at] + bytes([content[at] ^ 1 << draw.randrange(8)]) + content[at + 1 :]
        return f"flip a bit of {file}", put(file, changed)
    if kind == 1:
        return f"cut {file}", put(file, content[: draw.randrange(len(content) + 1)])
    if kind == 2:
        return f"more bytes at {file}", put(file, content + draw.randbytes(8))
    if kind == 3:
        return f"delete {file}", move(file, folder.with_name("deleted") / "file")
    if kind == 4:
        return f"exchange {file} and {other}", exchange(file, other)
    if kind == 5:
        return f"copy {other} over {file}", put(file, other.read_bytes())
    if kind == 6:
        copy = file.with_name(f"{file.stem} copy{file.suffix}")
        return f"copy {file} to {copy}", put(copy, content)
    chosen_folder = draw.choice(folders)
    if kind == 7:
        return f"delete {chosen_folder}", move(chosen_folder, folder.with_name("deleted") / "folder")
    apart = [
        path
        for path in folders
        if path not in (chosen_folder, *chosen_folder.parents) and chosen_folder not in path.parents
    ]
    same = [path for path in apart if len(path.parts) == len(chosen_folder.parts)]
    if apart and kind in (8, 9):
        theirs = draw.choice(same or apart)
        return f"exchange {chosen_folder} and {theirs}", exchange(chosen_folder, theirs)
    if apart and kind == 10:
        home = draw.choice(apart)
        if not (home / chosen_folder.name).exists():
            return f"move {chosen_folder} into {home}", move(chosen_folder, home / chosen_folder.name)
    changed = (
        content.replace(b"right", b"left_", 1).replace(b"correct", b"wrong__", 1).replace(b'": 0', b'": 1', 1)
    )
    return f"edit {file}", put(file, changed)


def assert_none_silent(name: Path, folder: Path, seeds: range) -> None:
    before, verdicts, wrong = tables_of(name), Counter[str](), list[str]()
    for seed in seeds:
        words, undo = change(folder, Random(seed))
        verdict_text = verdict(name, before)
        undo()
        verdicts[verdict_text.partition(" ")[0]] += 1
        if verdict_text not in ("same", "error"):
            wrong.append(f"seed {seed}: {words}: {verdict_text}")
    print(f"{len(seeds)} changes of {folder.name}: {dict(verdicts)}", flush=True)
    assert not wrong, "\n".join(wrong)
    assert tables_of(name) == before, "a change was not undone"
    assert verdicts["error"] > len(seeds) // 4


def assert_no_archive_is_silent(study: LoadedStudy, folder: Path, seeds: range) -> None:
    """Changes of an archive as a folder, and as a zip file."""
    pack_study(study, folder / "pack")
    assert_none_silent(folder / "pack", folder / "pack", seeds)
    pack_study(study, folder / "pack.zip")
    assert_no_zip_is_silent(folder / "pack.zip", folder, seeds)


def assert_no_zip_is_silent(archive: Path, folder: Path, seeds: range) -> None:
    """Changed bytes of the zip file itself."""
    before, content, verdicts, wrong = tables_of(archive), archive.read_bytes(), Counter[str](), list[str]()
    for seed in seeds:
        draw, changed = Random(seed), bytearray(content)
        start = draw.randrange(len(changed))
        for at in range(start, min(start + draw.choice([1, 1, 4, 300]), len(changed))):
            changed[at] ^= 1 << draw.randrange(8)
        if draw.random() < 0.2:
            del changed[draw.randrange(len(changed)) :]
        file = folder / f"changed-{seed}.zip"  # an unpacked archive is kept by its name
        file.write_bytes(changed)
        verdict_text = verdict(file, before)
        file.unlink()
        verdicts[verdict_text.partition(" ")[0]] += 1
        if verdict_text not in ("same", "error"):
            wrong.append(f"seed {seed}, byte {start}: {verdict_text}")
    print(f"{len(seeds)} changes of a zip file: {dict(verdicts)}", flush=True)
    assert not wrong, "\n".join(wrong)


# -- the study ---------------------------------------------------------------------------------------------


def copied(study: LoadedStudy, folder: Path) -> Path:
    """A study file in `folder` whose runs are a copy that a test may change."""
    shutil.copytree(study.study.folder, folder / "out")
    file = folder / "study.toml"
    text = study.file.read_text(encoding="utf-8").replace(study.study.folder, str(folder / "out"))
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.slow
def test_no_change_of_a_study_folder_is_silent(played: LoadedStudy, tmp_path: Path) -> None:
    assert_none_silent(copied(played, tmp_path), tmp_path / "out", range(FEW))


@pytest.mark.slow
def test_no_change_of_an_archive_is_silent(played: LoadedStudy, tmp_path: Path) -> None:
    assert_no_archive_is_silent(played, tmp_path, range(FEW))


@pytest.fixture(scope="module")
def probed(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> LoadedStudy:
    """Two networks, a VLM and probes."""
    study = load_study(small_study(tmp_path_factory.mktemp("probed"), small_suite))
    assert conduct_study(plan_study(study), env_workers=0) == []
    assert fit_probes(plan_study(study)) == []
    return study


@pytest.mark.slow
def test_none_of_three_hundred_changes_of_a_study_folder_is_silent(probed: LoadedStudy, tmp_path: Path) -> None:
    assert_none_silent(copied(probed, tmp_path), tmp_path / "out", range(MANY))


@pytest.mark.slow
def test_none_of_three_hundred_changes_of_an_archive_is_silent(probed: LoadedStudy, tmp_path: Path) -> None:
    assert_no_archive_is_silent(probed, tmp_path, range(MANY))
