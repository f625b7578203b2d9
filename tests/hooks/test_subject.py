"""What a subject tries a family with, derived from what the family declares."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from probe_kit.check_adapter.checking import _one_item
from probe_kit.hooks import Family, Option, registry
from probe_kit.hooks.conformance import subject
from probe_kit.hooks.conformance.check import SkipTest
from probe_kit.hooks.conformance.subject import INSTRUCTIONS, PolicySubject, Subject
from probe_kit.suite import load_suite

FAMILY = Family(
    "mine",
    "",
    None,
    "x:y",
    options=(
        Option("crop", bool, "crops", "false"),
        Option("head", str, "which head", "a", ("a", "b", "c")),
        Option("steps", int, "how many", "10"),
    ),
)


@pytest.fixture(autouse=True)
def _listed(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = SimpleNamespace(name="mine", load=lambda: FAMILY, value="x:y", dist=None)
    monkeypatch.setattr(registry, "family_entries", lambda: [entry])


def of(checkpoint: Path | None = None, **fields: Any) -> Subject:
    return PolicySubject("mine", checkpoint, **fields)


def test_other_values_are_known_of_switches_and_lists_and_where_they_are_told() -> None:
    assert of().other_options == {"crop": (True,), "head": ("b", "c")}
    assert of(options={"crop": "yes", "head": "b"}).other_options == {"crop": (False,), "head": ("a", "c")}
    assert of(other_options={"steps": 3}).other_options["steps"] == (3,)


def test_a_checkpoint_that_is_too_large_to_copy_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "model.safetensors").write_bytes(bytes(2000))
    assert of(tmp_path).checkpoint == tmp_path
    monkeypatch.setattr(subject, "LARGEST_COPY", 1000)
    with pytest.raises(SkipTest, match="would be copied; check a tiny one"):
        _ = of(tmp_path).checkpoint
    with pytest.raises(SkipTest, match="brings its own weights"):
        _ = of().checkpoint


def test_check_adapter_removes_the_files_that_it_wrote() -> None:
    with of() as written_subject:
        first, second = written_subject.folder, written_subject.folder
        assert first != second
        assert not any(first.iterdir())
    assert not first.exists()
    assert not first.parent.exists()


def test_the_instructions_differ_in_length_and_some_are_alike() -> None:
    any_subject = of(model=SimpleNamespace(card=SimpleNamespace(needs=frozenset())))
    assert len({len(observation.instruction) for observation in any_subject.observations}) == 2
    assert len({len(observation.instruction) for observation in any_subject.alike}) < len(any_subject.alike)


@pytest.mark.parametrize("instruction", [INSTRUCTIONS[0], "grasp it", "stop"])
def test_one_item_of_any_instruction_is_a_suite(instruction: str, tmp_path: Path) -> None:
    suite = load_suite(_one_item(instruction, tmp_path))
    assert [item.instruction for item in suite.items] == [instruction]
