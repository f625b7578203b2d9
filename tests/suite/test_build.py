import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier
from typing import Any

import pytest

from probe_kit.errors import SuiteError, UnknownCategoryError, UsageError
from probe_kit.suite import Suite, build_suite, default_suite
from probe_kit.suite.suite import drawing_libraries


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below `folder` with its bytes."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_two_builds_are_equal_byte_for_byte(tmp_path: Path) -> None:
    build_suite(tmp_path / "one", items_per_category=4)
    build_suite(tmp_path / "two", items_per_category=4)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_another_seed_gives_other_items(tmp_path: Path) -> None:
    first = build_suite(tmp_path / "one", ["color"], 4, seed=0)
    other = build_suite(tmp_path / "other", ["color"], 4, seed=1)
    assert not {item.item_id for item in first.items} & {item.item_id for item in other.items}


@pytest.mark.slow
def test_a_small_suite_is_the_beginning_of_a_large_one(small_suite: Suite, embedded: Suite) -> None:
    large = [item for item in embedded.items if item.category == "shape"]
    small = [item for item in small_suite.items if item.category == "shape"]
    assert [item.to_json() for item in small] == [item.to_json() for item in large[: len(small)]]


def test_items_of_a_category_do_not_depend_on_the_other_categories(small_suite: Suite, tmp_path: Path) -> None:
    alone = build_suite(tmp_path / "alone", ["shape"], 12)
    assert alone.content_sha256 == small_suite.select(["shape"]).content_sha256


def test_categories_are_built_in_one_order_however_they_are_named(small_suite: Suite, tmp_path: Path) -> None:
    again = build_suite(tmp_path / "again", ["shape", "color", "shape"], 12)
    assert contents(again.folder) == contents(small_suite.folder)


@pytest.mark.parametrize("count", [-2, 0, 7])
def test_a_number_of_items_without_twins_is_refused(tmp_path: Path, count: int) -> None:
    with pytest.raises(
        UsageError, match=f"{count} items per category are asked for; expected a positive even number"
    ):
        build_suite(tmp_path / "suite", items_per_category=count)
    assert list(tmp_path.iterdir()) == []


def test_each_category_may_have_its_number_of_items(small_suite: Suite, tmp_path: Path) -> None:
    """Its items are those of a suite with the same number everywhere."""
    calls: list[tuple[int, int]] = []
    counts = {"color": 2, "shape": 12}
    suite = build_suite(tmp_path / "suite", ["color", "shape"], counts, progress=lambda *call: calls.append(call))
    assert suite.card["counts"] == counts == suite.card["options"]["items_per_category"]
    assert calls[-1] == (14, 14)
    assert suite.select(["shape"]).content_sha256 == small_suite.select(["shape"]).content_sha256


def test_equal_numbers_of_items_are_one_number(small_suite: Suite, tmp_path: Path) -> None:
    again = build_suite(tmp_path / "again", ["color", "shape"], {"shape": 12, "color": 12})
    assert contents(again.folder) == contents(small_suite.folder)


@pytest.mark.parametrize("counts", [{"color": 2}, {"color": 2, "shape": 2, "state": 2}, {}])
def test_numbers_of_items_of_other_categories_are_refused(tmp_path: Path, counts: dict[str, int]) -> None:
    with pytest.raises(UsageError, match="expected one for each of color, shape"):
        build_suite(tmp_path / "suite", ["color", "shape"], counts)
    with pytest.raises(UsageError, match="3 items per category are asked for; expected a positive even number"):
        build_suite(tmp_path / "suite", ["color", "shape"], {"color": 2, "shape": 3})
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_category_is_refused_with_the_nearest_name(tmp_path: Path) -> None:
    with pytest.raises(UnknownCategoryError, match="Did you mean 'counting'"):
        build_suite(tmp_path / "suite", ["Countin"])


def test_a_category_that_is_never_embedded_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownCategoryError, match="unknown category 'celebrity'; available: emotion"):
        build_suite(tmp_path / "suite", ["celebrity"])


def test_building_no_category_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no category to build"):
        build_suite(tmp_path / "suite", [])


def test_progress_is_told_items_done_and_items_in_all(tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    build_suite(tmp_path / "suite", ["color", "shape"], 4, progress=lambda *call: calls.append(call))
    assert calls == [(2, 8), (4, 8), (6, 8), (8, 8)]


def test_a_folder_in_use_is_refused_before_anything_is_drawn(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work", encoding="utf-8")

    def progress(_done: int, _total: int) -> None:
        pytest.fail("something was drawn")

    with pytest.raises(SuiteError, match="exists and holds no suite; expected a new folder"):
        build_suite(tmp_path, progress=progress)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_another_suite_is_never_overwritten(small_suite: Suite) -> None:
    before = contents(small_suite.folder)
    with pytest.raises(SuiteError, match=f"already holds {small_suite.identity}; expected a2a-embedded@"):
        build_suite(small_suite.folder, ["color"], 2)
    assert contents(small_suite.folder) == before


def test_building_the_very_same_suite_again_leaves_the_folder_alone(small_suite: Suite) -> None:
    stamp = (small_suite.folder / "suite.json").stat().st_mtime_ns
    assert build_suite(small_suite.folder, ["color", "shape"], 12) == small_suite
    assert (small_suite.folder / "suite.json").stat().st_mtime_ns == stamp


def test_a_build_that_breaks_off_leaves_nothing_behind(tmp_path: Path) -> None:
    def interrupt(_done: int, _total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_suite(tmp_path / "suite", progress=interrupt)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_two_builders_of_one_suite_at_once_both_get_it(tmp_path: Path) -> None:
    both_are_about_to_write = Barrier(2, timeout=20)

    def build() -> Suite:
        return build_suite(
            tmp_path / "suite",
            ["color"],
            40,
            progress=lambda finished, total: both_are_about_to_write.wait() if finished == total else None,
        )

    with ThreadPoolExecutor(2) as pool:
        first, other = pool.submit(build), pool.submit(build)
    assert first.result() == other.result()
    assert [path.name for path in tmp_path.iterdir()] == ["suite"]


def test_the_default_suite_is_built_once_and_then_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path))
    built: list[int] = []
    first = default_suite(["color"], 4, progress=lambda finished, _: built.append(finished))
    again = default_suite(["color"], 4, progress=lambda finished, _: built.append(finished))
    assert first == again
    assert built == [2, 4]
    assert first.folder.parent == tmp_path / "suites"


def test_without_a_named_cache_the_home_folder_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PROBE_KIT_CACHE")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_suite(["color"], 2).folder.parent == tmp_path / ".cache" / "probe_kit" / "suites"


def test_default_suites_with_other_options_do_not_meet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path))
    suites = [default_suite(["color"], 2), default_suite(["shape"], 2), default_suite(["color"], 2, seed=1)]
    assert len({suite.folder for suite in suites}) == 3


@pytest.mark.parametrize("library", ["pillow", "freetype", "numpy"])
def test_another_version_of_what_draws_is_another_suite_in_the_cache(
    library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path))
    before = default_suite(["color"], 2).folder
    versions = {**drawing_libraries(), library: "0.0"}
    monkeypatch.setattr("probe_kit.suite.build.drawing_libraries", lambda: versions)
    assert default_suite(["color"], 2).folder != before


@pytest.mark.parametrize("source", ["items.py", "pictures.py", "suite.py", "generators/drawing.py"])
def test_other_code_that_draws_or_words_is_another_suite_in_the_cache(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path))
    before = default_suite(["color"], 2).folder
    read = Path.read_text

    def edited(path: Path, *arguments: Any, **options: Any) -> str:
        text = read(path, *arguments, **options)
        return f"{text}\n# edited" if path.match(f"probe_kit/suite/{source}") else text

    monkeypatch.setattr(Path, "read_text", edited)
    assert default_suite(["color"], 2).folder != before


def test_a_damaged_cache_is_reported_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path))
    suite = default_suite(["color"], 2)
    suite.items[0].picture("left").write_bytes(b"")
    with pytest.raises(SuiteError, match=r"E06 .*\n[^$]*delete the folder"):
        default_suite(["color"], 2)


def test_importing_the_suite_stays_light() -> None:
    heavy = "torch", "pandas", "matplotlib", "sklearn", "scipy"
    code = f"import sys, probe_kit.suite; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True)
    assert result.stdout.strip() == "[]"
