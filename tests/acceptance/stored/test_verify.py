"""`run verify`: silent about a whole run, and exit code 1 with the place for every kind of damage."""

import shutil
from collections.abc import Callable
from itertools import cycle
from pathlib import Path

import pytest

import probe_kit as pk
from tests.acceptance.product import probe_kit
from tests.acceptance.stored.conftest import StoredRuns

FREE = ("label.json",)
"""The name in tables may be changed, as docs/storage.md says."""
MAY_BE_LOST = ("certificates", "sealed", "label.json")
"""Kinds of which the page says that a single file here may be missing: it is derived, or a whole kind is lost."""

Damage = Callable[[Path, list[Path]], list[Path]]
"""Damages the first of these files of a run, and returns the files that it touched."""


def kind_of(file: Path) -> str:
    """The sort of thing that a file of a run holds, such as `data.zarr/backbone` or `commits`."""
    top, *below = file.parts
    if not below:
        return top
    if top in ("probes", "interventions"):
        return f"{top}/{file.name}"
    if file.name == "zarr.json":
        return f"{top}/{file.name}"
    return f"{top}/{below[0]}" if len(below) > 1 else top


def files_by_kind(run: Path) -> dict[str, list[Path]]:
    kinds: dict[str, list[Path]] = {}
    for file in sorted(path.relative_to(run) for path in run.rglob("*") if path.is_file()):
        kinds.setdefault(kind_of(file), []).append(file)
    return kinds


def change(run: Path, files: list[Path]) -> list[Path]:
    """Turn over the bits of one byte in the middle."""
    content = bytearray((run / files[0]).read_bytes())
    content[len(content) // 2] ^= 0xFF
    (run / files[0]).write_bytes(content)
    return files[:1]


def truncate(run: Path, files: list[Path]) -> list[Path]:
    """Cut off the last bytes, as a full disk or a broken transfer does."""
    content = (run / files[0]).read_bytes()
    (run / files[0]).write_bytes(content[: max(0, len(content) - 7)])
    return files[:1]


def swap(run: Path, files: list[Path]) -> list[Path]:
    """Exchange two files of one kind that differ, if there are two."""
    first = run / files[0]
    for file in files[1:]:
        contents = first.read_bytes(), (run / file).read_bytes()
        if contents[0] != contents[1]:
            first.write_bytes(contents[1])
            (run / file).write_bytes(contents[0])
            return [files[0], file]
    return []


def delete(run: Path, files: list[Path]) -> list[Path]:
    (run / files[0]).unlink()
    return files[:1]


DAMAGES: tuple[Damage, ...] = (change, truncate, swap, delete)


@pytest.fixture
def copied(runs: StoredRuns, tmp_path: Path) -> Path:
    """A copy of the untrained run, which has data, columns, probes and pictures."""
    return Path(shutil.copytree(runs.untrained, tmp_path / "run"))


def undetected(intact: Path, run: Path, kind: str, damage: Damage) -> str | None:
    """Damage `run`, verify, and repair it from `intact`. Return the damage if it went through, else None."""
    files = files_by_kind(intact)[kind]
    touched = damage(run, files)
    try:
        answer = probe_kit("run", "verify", run, "--deep", "--json", code=None)
    finally:
        for file in touched:
            shutil.copyfile(intact / file, run / file)
    assert "InternalError" not in answer.text, answer.text
    without_root = (kind, damage) == ("run.json", delete)  # no run any more: wrong usage
    if not touched or answer.code == (2 if without_root else 1):
        return None
    if damage is delete and kind == "commits" and not answer.json()["finished"]:
        return None  # a run without columns: a lost commit is an episode that is missing
    return f"{damage.__name__} of {files[0]}: exit code {answer.code}"


def test_an_untouched_run_has_no_problem_and_every_episode(runs: StoredRuns) -> None:
    for run in (runs.trained, runs.untrained, runs.asked, runs.expert):
        answer = probe_kit("run", "verify", run, "--deep", "--json").json()
        assert answer["ok"]
        assert answer["finished"]
        assert answer["problems"] == []
        assert answer["committed"] == answer["planned"] == len(pk.open_run(run).episodes)


def test_damage_of_every_kind_of_file_is_exit_code_1(runs: StoredRuns, copied: Path) -> None:
    kinds = [kind for kind in files_by_kind(copied) if kind not in FREE]
    assert {kind.partition("/")[0] for kind in kinds} >= {"commits", "plan", "data.zarr", "columns.zarr", "probes"}
    passed = []
    for kind, damage in zip(kinds, cycle(DAMAGES), strict=False):
        if damage is delete and kind.partition("/")[0] in MAY_BE_LOST:
            continue
        passed.append(undetected(runs.untrained, copied, kind, damage))
    assert [problem for problem in passed if problem] == []


@pytest.mark.slow
def test_every_damage_of_every_kind_of_file_is_exit_code_1(runs: StoredRuns, tmp_path: Path) -> None:
    passed = []
    for number, intact in enumerate((runs.trained, runs.asked)):
        run = Path(shutil.copytree(intact, tmp_path / str(number)))
        for kind in files_by_kind(intact):
            if kind in FREE:
                continue
            for damage in DAMAGES:
                if damage is delete and kind.partition("/")[0] in MAY_BE_LOST:
                    continue
                passed.append(undetected(intact, run, kind, damage))
    assert [problem for problem in passed if problem] == []


def test_damage_names_its_file_and_never_becomes_a_number(copied: Path) -> None:
    damaged = next((copied / "data.zarr" / "backbone").rglob("c/*/**/*[0-9]"), None)
    assert damaged is not None
    while damaged.is_dir():
        damaged = next(damaged.iterdir())
    shutil.rmtree(copied / "columns.zarr")
    shutil.rmtree(copied / "sealed")
    sound = pk.open_run(copied)
    with pytest.warns(UserWarning, match="not sealed"):
        assert len(sound.column(pk.Site("backbone", 0), "mean")) == len(sound.episodes)
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    answer = probe_kit("run", "verify", copied, "--deep", code=1)
    assert "backbone" in answer.text
    with pytest.raises(pk.ProbeKitError, match="backbone"), pytest.warns(UserWarning, match="not sealed"):
        pk.open_run(copied).column(pk.Site("backbone", 0), "mean")


def test_a_damaged_result_stops_the_table_by_name(copied: Path) -> None:
    (scores, *_) = sorted(copied.glob("probes/*/*.parquet")) or sorted(copied.glob("probes/*/*"))
    content = bytearray(scores.read_bytes())
    content[len(content) // 2] ^= 1
    scores.write_bytes(content)
    answer = probe_kit("retention", copied, code=1)
    assert "RunDamagedError" in answer.err
    assert not answer.out


@pytest.mark.slow
def test_a_grown_run_is_whole_and_equals_one_that_was_played_at_once(tmp_path: Path) -> None:
    settings = ("--model", "pi0-tiny", "--no-act", "--categories", "color", "--env-workers", "0", "--batch", "1")
    for run, items in (("grown", 2), ("grown", 4), ("once", 4)):
        probe_kit("extract", *settings, "--items", items, "--out", tmp_path / run)
        assert probe_kit("run", "verify", tmp_path / run, "--deep", "--json").json()["ok"]
    grown, once = (pk.open_run(tmp_path / name) for name in ("grown", "once"))
    assert grown.episodes["episode_id"].tolist() == once.episodes["episode_id"].tolist()
    for site in (pk.Site("backbone", 3), pk.Site("expert", 1, iteration=4)):
        assert grown.column(site, "mean").tobytes() == once.column(site, "mean").tobytes()
    file = next((tmp_path / "grown" / "commits").iterdir())
    file.write_bytes(file.read_bytes()[:-9])
    assert probe_kit("run", "verify", tmp_path / "grown", "--deep", code=None).code == 1
