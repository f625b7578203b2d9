"""What the command tries a family with, derived from what the family declares."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from probe_kit.check_adapter import trial
from probe_kit.check_adapter.smoke_run import _one_item
from probe_kit.check_adapter.trial import INSTRUCTIONS, Trial
from probe_kit.hooks import Family, Option
from probe_kit.hooks.conformance.check import SkipTest
from probe_kit.suite import load_suite

FAMILY = Family(
    "mine",
    "",
    None,
    "x:y",
    options=(
        Option("crop", bool, "crops", "false"),
        Option("head", str, "which head", "a", ("a", "b")),
        Option("steps", int, "how many", "10"),
    ),
)


def test_another_value_is_told_of_switches_and_lists_and_of_nothing_else() -> None:
    plain = Trial(FAMILY, None, {}, INSTRUCTIONS)
    assert plain.other_options == {"crop": True, "head": "b"}
    assert plain.settings.unloadable_options == {"steps"}
    chosen = Trial(FAMILY, None, {"crop": True, "head": "b"}, INSTRUCTIONS)
    assert chosen.other_options == {"crop": False, "head": "a"}
    for own in (plain, chosen):
        own.close()


def test_a_checkpoint_that_is_too_large_to_copy_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "model.safetensors").write_bytes(bytes(2000))
    own = Trial(FAMILY, str(tmp_path), {}, INSTRUCTIONS)
    assert own.checkpoint == tmp_path
    monkeypatch.setattr(trial, "LARGEST_COPY", 1000)
    with pytest.raises(SkipTest, match="would be copied; check a tiny one"):
        _ = Trial(FAMILY, str(tmp_path), {}, INSTRUCTIONS).checkpoint
    with pytest.raises(SkipTest, match="brings its own weights"):
        _ = Trial(FAMILY, None, {}, INSTRUCTIONS).checkpoint


def test_what_was_written_is_removed() -> None:
    own = Trial(FAMILY, None, {}, INSTRUCTIONS)
    first, second = own.folder, own.folder
    assert first != second
    assert not any(first.iterdir())
    own.close()
    assert not first.exists()
    assert not first.parent.exists()


def test_questions_become_longer_by_a_word_of_the_instructions() -> None:
    assert Trial(FAMILY, None, {}, ("grasp the cup", "stop")).settings.other_words == " cup"


def test_the_instructions_differ_in_length_and_some_are_alike() -> None:
    model = SimpleNamespace(card=SimpleNamespace(needs=frozenset()))
    own = Trial(FAMILY, None, {}, INSTRUCTIONS)
    own.loaded = model  # type: ignore[assignment]
    assert len({len(one.instruction) for one in own.observations}) == 2
    assert len({len(one.instruction) for one in own.alike}) < len(own.alike)
    own.close()


@pytest.mark.parametrize("instruction", [INSTRUCTIONS[0], "grasp it", "stop"])
def test_one_item_of_any_instruction_is_a_suite(instruction: str, tmp_path: Path) -> None:
    suite = load_suite(_one_item(instruction, tmp_path))
    assert [item.instruction for item in suite.items] == [instruction]
