"""Foreign archives of studies, as folders and zip files: what leads out, grows, or was not packed is refused."""

import hashlib
import json
import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile, ZipInfo

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import ProbeKitError, RunDamagedError, UsageError
from probe_kit.study import archive
from probe_kit.study.archive import PACK_FILE, STUDY_FILE, SUMS_FILE, open_archive, write_sums

Change = Callable[[Path], object]
OUTSIDE = [
    "/etc/outside", "../outside", "runs/../../outside", "runs\\..\\..\\outside", "..\\outside", "C:/outside",
    "C:outside", "//server/share/outside", "\\\\server\\share\\outside", "./outside", "runs//outside", "nul",
    "runs/con.json", "runs/Com1 .txt", "runs/line\nbreak", "runs/\x1b[2Jclear", f"runs/{'x' * 300}",
    "x/" * 150 + "x",
]  # fmt: skip


@pytest.fixture
def packed(tmp_path: Path) -> Path:
    """A folder with the sums of a study's file, a record and a file of a run."""
    folder = tmp_path / "packed"
    (folder / "runs").mkdir(parents=True)
    (folder / STUDY_FILE).write_text("name = 'x'\n", encoding="utf-8")
    (folder / PACK_FILE).write_text("{}", encoding="utf-8")
    (folder / "runs" / "run.json").write_text("{}", encoding="utf-8")
    write_sums(folder)
    return folder


def zipped(folder: Path, *extra_members: tuple[str, bytes], kind: int = stat.S_IFREG) -> Path:
    """The folder's files as a zip file. extra_members: names and contents; of this kind of file."""
    out = folder.with_suffix(".zip")
    with ZipFile(out, "w", ZIP_DEFLATED) as file:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                file.write(path, path.relative_to(folder).as_posix())
        for name, content in extra_members:
            info = ZipInfo(name)
            info.external_attr, info.compress_type = (kind | 0o644) << 16, ZIP_DEFLATED
            file.writestr(info, content)
    return out


def outside(folder: Path) -> set[Path]:
    """All files that lie about the archive."""
    return {path for path in folder.parent.rglob("*") if folder not in path.parents}


def test_the_archive_that_is_changed_below_is_whole(packed: Path) -> None:
    assert open_archive(packed) == packed
    assert (unpacked := open_archive(zipped(packed))) is not None
    assert (unpacked / "runs" / "run.json").read_text(encoding="utf-8") == "{}"


# -- links and other kinds ---------------------------------------------------------------------------------


def link_out(folder: Path) -> None:
    (folder.parent / "secret").write_text("{}", encoding="utf-8")
    (folder / "runs" / "run.json").unlink()
    (folder / "runs" / "run.json").symlink_to(folder.parent / "secret")


def linked_folder(folder: Path) -> None:
    shutil.move(folder / "runs", folder.parent / "runs")
    (folder / "runs").symlink_to(folder.parent / "runs")


def dangling(folder: Path) -> None:
    (folder / "runs" / "more").symlink_to("nowhere")


def pipe(folder: Path) -> None:
    os.mkfifo(folder / "runs" / "more")


def linked_sums(folder: Path) -> None:
    shutil.move(folder / SUMS_FILE, folder.parent / "sums")
    (folder / SUMS_FILE).symlink_to(folder.parent / "sums")


@pytest.mark.parametrize("change", [link_out, linked_folder, dangling, pipe, linked_sums])
def test_a_folder_with_a_link_or_pipe_is_refused_and_no_link_is_followed(change: Change, packed: Path) -> None:
    change(packed)
    with pytest.raises(RunDamagedError, match=r"is a link or no regular file"):
        open_archive(packed)


def test_a_hard_link_has_the_bytes_of_its_sum_or_is_refused(packed: Path) -> None:
    """It is a regular file: it leads to bytes, and these are compared."""
    os.link(packed / "runs" / "run.json", packed.parent / "outside")
    assert open_archive(packed) == packed
    os.link(packed / STUDY_FILE, packed / "runs" / "more")
    with pytest.raises(RunDamagedError, match="was not packed"):
        open_archive(packed)


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR, stat.S_IFSOCK, stat.S_IFDIR])
def test_a_zip_file_has_regular_members_alone(kind: int, packed: Path) -> None:
    file = zipped(packed, ("runs/more", b"/etc/passwd"), kind=kind)
    before = outside(packed)
    with pytest.raises(RunDamagedError, match=r"'runs/more', which is no regular file"):
        open_archive(file)
    assert outside(packed) == before


# -- names ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_member_whose_name_leads_out_is_refused_before_anything_is_written(
    name: str, packed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unpacked = packed.parent / "unpacked"
    monkeypatch.setattr(archive.tempfile, "mkdtemp", lambda **_: str(unpacked))
    unpacked.mkdir()
    file = zipped(packed, (name, b"{}"))
    before = outside(packed)
    with pytest.raises(RunDamagedError, match=r"which is no file below its folder"):
        open_archive(file)
    assert outside(packed) == before


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_sum_whose_name_leads_out_is_refused_by_its_line(name: str, packed: Path) -> None:
    (packed.parent / "outside").write_text("{}", encoding="utf-8")
    digest = hashlib.sha256(b"{}").hexdigest()
    with (packed / SUMS_FILE).open("a", encoding="utf-8", newline="\n") as sums:
        sums.write(f"{digest}  {name}\n")
    for source in (packed, zipped(packed)):
        with pytest.raises(RunDamagedError, match=r"no sha256 and name|no file below its folder"):
            open_archive(source)


@pytest.mark.parametrize("name", ["runs/run.json", STUDY_FILE, SUMS_FILE])
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_members_of_one_name_are_refused(name: str, packed: Path) -> None:
    with pytest.raises(RunDamagedError, match=r"has two files called"):
        open_archive(zipped(packed, (name, b"other")))


def test_a_name_that_is_a_file_and_a_folder_at_once_is_refused(packed: Path) -> None:
    for name in ("runs/run.json/more", "runs"):
        with pytest.raises(RunDamagedError, match="a file and a folder of one name"):
            open_archive(zipped(packed, (name, b"{}")).rename(packed.parent / f"{len(name)}.zip"))


# -- sizes ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_zip_file_that_unpacks_to_a_thousand_times_its_size_is_refused(packed: Path) -> None:
    file = zipped(packed, ("runs/zeros", bytes(80 << 20)))
    assert file.stat().st_size < 1 << 20
    with pytest.raises(RunDamagedError, match=r"unpacks to [\d,]+; expected at most 200 times"):
        open_archive(file)


def test_a_member_ends_at_the_size_that_it_declares(packed: Path) -> None:
    """A header that declares little is no way around the bound: the rest is refused by its checksum."""
    file = zipped(packed, ("runs/zeros", bytes(1 << 20)))
    content = bytearray(file.read_bytes())
    directory = content.rindex(b"runs/zeros") - 46
    assert content[directory : directory + 4] == b"PK\x01\x02"
    content[directory + 24 : directory + 28] = (10).to_bytes(4, "little")
    file.write_bytes(content)
    with pytest.raises(RunDamagedError, match="no whole zip file"):
        open_archive(file)


@pytest.mark.parametrize("as_zip", [False, True], ids=["folder", "zip"])
def test_more_files_than_an_archive_has_are_refused_by_their_number(
    as_zip: bool, packed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = zipped(packed) if as_zip else packed
    monkeypatch.setattr(archive, "MOST_FILES", 3)
    with pytest.raises(RunDamagedError, match="has 4 files of"):
        open_archive(source)


def test_a_sparse_file_beyond_all_disks_is_refused_by_its_size(packed: Path) -> None:
    with (packed / "runs" / "more").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(RunDamagedError, match="an archive has at most"):
        open_archive(packed)


@pytest.mark.parametrize("name", [SUMS_FILE, PACK_FILE])
def test_records_have_a_bound_of_their_own(name: str, packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (packed / name).write_bytes((packed / name).read_bytes() + b"\n" * 1000)
    monkeypatch.setattr(archive, "MOST_RECORD_BYTES", 1000)
    with pytest.raises(RunDamagedError, match="it has 0 MB; expected at most 0 MB"):
        archive.Pack.read(packed) if name == PACK_FILE else open_archive(packed)


def test_an_archive_within_an_archive_is_a_file_like_any_other_and_is_not_unpacked(packed: Path) -> None:
    inner = zipped(packed).read_bytes()
    with pytest.raises(RunDamagedError, match=r"inner\.zip was not packed"):
        open_archive(zipped(packed, ("runs/inner.zip", inner)))
    (packed / "runs" / "inner.zip").write_bytes(inner)
    write_sums(packed)
    unpacked = open_archive(zipped(packed))
    assert unpacked is not None
    assert (unpacked / "runs" / "inner.zip").read_bytes() == inner
    assert not (unpacked / "runs" / "inner").exists()


# -- sums -------------------------------------------------------------------------------------------------


def without_line(folder: Path) -> None:
    lines = (folder / SUMS_FILE).read_text(encoding="utf-8").splitlines(keepends=True)
    (folder / SUMS_FILE).write_text("".join(line for line in lines if "run.json" not in line), encoding="utf-8")


def further_file(folder: Path) -> None:
    (folder / "runs" / "deep").mkdir()
    (folder / "runs" / "deep" / ".hidden").write_bytes(b"")


def twice(folder: Path) -> None:
    text = (folder / SUMS_FILE).read_text(encoding="utf-8")
    (folder / SUMS_FILE).write_text(text + text.splitlines(keepends=True)[0], encoding="utf-8")


def half_a_line(folder: Path) -> None:
    text = (folder / SUMS_FILE).read_text(encoding="utf-8")
    (folder / SUMS_FILE).write_text(text[:-5], encoding="utf-8")


def no_sums(folder: Path) -> None:
    (folder / SUMS_FILE).unlink()


def lost_file(folder: Path) -> None:
    (folder / "runs" / "run.json").unlink()


def other_bytes(folder: Path) -> None:
    (folder / "runs" / "run.json").write_bytes(b"[]")


def no_text(folder: Path) -> None:
    (folder / SUMS_FILE).write_bytes(b"\xff\xfe\n")


def capitals(folder: Path) -> None:
    text = (folder / SUMS_FILE).read_text(encoding="utf-8")
    (folder / SUMS_FILE).write_text(text.replace(text[:64], text[:64].upper()), encoding="utf-8")


@pytest.mark.parametrize("as_zip", [False, True], ids=["folder", "zip"])
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (without_line, r"run\.json was not packed: SHA256SUMS does not have it"),
        (further_file, r"deep/\.hidden was not packed"),
        (twice, r"names 'pack\.json' twice"),
        (half_a_line, "ends within a line"),
        (no_sums, "has no SHA256SUMS"),
        (lost_file, r"run\.json is missing"),
        (other_bytes, r"run\.json has other bytes than were packed"),
        (no_text, "is no UTF-8 text"),
        (capitals, "line 1: .* is no sha256 and name"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_sums_name_every_file_once_and_no_other_file(
    change: Change, reason: str, as_zip: bool, packed: Path
) -> None:
    change(packed)
    with pytest.raises(RunDamagedError, match=reason):
        open_archive(zipped(packed) if as_zip else packed)


# -- formats ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".tar", ".tar.gz", ".tgz", ".zip.txt"])
def test_a_tape_archive_is_no_archive_of_a_study(ending: str, packed: Path) -> None:
    """The product writes folders and zip files, and reads no other format."""
    tape = shutil.make_archive(str(packed.parent / "made"), "gztar", packed)
    file = Path(tape).rename(packed.parent / f"study{ending}")
    assert open_archive(file) is None
    answer = CliRunner().invoke(app, ["study", "table", str(file), "main"])
    assert (answer.exit_code, isinstance(answer.exception, SystemExit | None)) == (2, True)


def test_a_tape_archive_called_zip_and_a_zip_file_with_a_password_are_refused(packed: Path) -> None:
    tape = Path(shutil.make_archive(str(packed.parent / "made"), "gztar", packed))
    with pytest.raises(RunDamagedError, match="no whole zip file"):
        open_archive(tape.rename(packed.parent / "tape.zip"))
    file = zipped(packed)
    content = bytearray(file.read_bytes())
    for start in (content.index(b"PK\x03\x04") + 6, content.index(b"PK\x01\x02") + 8):
        content[start] |= 1
    file.write_bytes(content)
    with pytest.raises(RunDamagedError, match="cannot be read"):
        open_archive(file)


@pytest.mark.parametrize(
    "content", ["", "[]", "null", "[" * 100_000, '{"study": 1}', '{"a": 1, "a": 2}', "\xff", "NaN"]
)
def test_a_record_of_another_shape_is_refused_by_name(content: str, packed: Path) -> None:
    (packed / PACK_FILE).write_text(content, encoding="latin-1")
    write_sums(packed)
    with pytest.raises(RunDamagedError, match=r"pack\.json is no record of an archive"):
        archive.Pack.read(packed)


def test_a_record_of_a_later_schema_names_both_versions(packed: Path) -> None:
    (packed / PACK_FILE).write_text(json.dumps({"schema_version": 9}), encoding="utf-8")
    with pytest.raises(UsageError, match="schema 9; this version reads 2"):
        archive.Pack.read(packed)


def test_a_stored_zip_file_without_any_member_is_no_archive(tmp_path: Path) -> None:
    with ZipFile(tmp_path / "empty.zip", "w", ZIP_STORED):
        pass
    with pytest.raises(ProbeKitError, match=r"has no pack\.json"):
        open_archive(tmp_path / "empty.zip")
