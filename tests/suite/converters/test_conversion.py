import json
from pathlib import Path

import pytest

from probe_kit.errors import SuiteError, UnknownCategoryError, UsageError
from probe_kit.suite import load_suite, validate_suite
from probe_kit.suite.converters import SOURCES, convert


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_two_conversions_are_equal_byte_for_byte(vlthink_root: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        convert("vl-think", vlthink_root, tmp_path / name)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_another_seed_gives_another_sample(vlthink_root: Path, tmp_path: Path) -> None:
    first = convert("vl-think", vlthink_root, tmp_path / "one", n=6, seed=0)
    other = convert("vl-think", vlthink_root, tmp_path / "other", n=6, seed=1)
    assert {item.pair_id for item in first.items} != {item.pair_id for item in other.items}


@pytest.mark.slow
def test_a_converted_suite_is_valid_and_says_nobody_looked(compbench_root: Path, tmp_path: Path) -> None:
    suite = convert("mllm-compbench", compbench_root, tmp_path / "suite")
    assert load_suite(suite.folder) == suite
    assert validate_suite(suite.folder).errors == ()
    assert suite.card["curation"] == ["rules-only"]
    assert suite.card["curation_sha256"] == "none"
    assert set(suite.card["annotation_files"]) >= {"fer2013_0_720_rebalanced.json"}


def test_every_stage_is_counted_beside_the_paper(vlthink_root: Path, tmp_path: Path) -> None:
    suite = convert("vl-think", vlthink_root, tmp_path / "suite", n=6)
    stats = json.loads((suite.folder / "stats.json").read_text(encoding="utf-8"))
    assert stats["traffic"] == {
        "pool": 5,
        "rule_selected": 5,
        "image_ok": 5,
        "text_ok": 5,
        "needs_edit": 0,
        "paired": 20,
        "accepted": 20,
        "emitted": 6,
        "paper_pool": 24,
        "paper_items": 150,
    }
    assert any("traffic: pool of 5, the paper has 24" in note for note in stats["notes"])


def test_a_converted_suite_names_no_place_on_this_machine(vlthink_root: Path, tmp_path: Path) -> None:
    suite = convert("vl-think", vlthink_root, tmp_path / "suite")
    for name, content in contents(suite.folder).items():
        assert str(tmp_path).encode() not in content, name


def test_an_unknown_source_category_option_or_root_is_wrong_usage(vlthink_root: Path, tmp_path: Path) -> None:
    out = tmp_path / "suite"
    with pytest.raises(UsageError, match="unknown source 'vqa'; available: mllm-compbench"):
        convert("vqa", vlthink_root, out)
    with pytest.raises(UnknownCategoryError, match="unknown category 'shape'; available: color"):
        convert("vl-think", vlthink_root, out, categories=["shape"])
    with pytest.raises(UsageError, match=r"unknown option 'recolour'.*Did you mean 'recolor'"):
        convert("vl-think", vlthink_root, out, recolour=True)
    with pytest.raises(UsageError, match="does not exist"):
        convert("vl-think", tmp_path / "nowhere", out)
    with pytest.raises(UsageError, match="n is 0"):
        convert("vl-think", vlthink_root, out, n=0)
    assert not out.exists()


def test_a_folder_in_use_is_refused(vlthink_root: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("years of work", encoding="utf-8")
    with pytest.raises(SuiteError, match="holds no suite; expected a new folder"):
        convert("vl-think", vlthink_root, tmp_path / "full")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"min_side": 5000}, "picture too small"),
        ({"min_spread": 500.0}, "picture nearly blank"),
        ({"max_words": 3}, "instruction has too many words"),
        ({"max_characters": 9}, "instruction too long"),
    ],
)
def test_filters_that_leave_nothing_say_what_they_removed(
    vlthink_root: Path, tmp_path: Path, options: dict[str, float], reason: str
) -> None:
    with pytest.raises(SuiteError, match=f"no item left to write.*{reason}"):
        convert("vl-think", vlthink_root, tmp_path / "suite", categories=["traffic"], side_words=True, **options)
    assert not (tmp_path / "suite").exists()


def test_the_five_sources_together_cover_all_twelve_categories() -> None:
    assert len({category for source in SOURCES.values() for category in source.categories}) == 12
