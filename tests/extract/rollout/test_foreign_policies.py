"""A policy written by others costs its own episodes, by name, whatever its code does."""

import json
import pickle
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import ActionError, CheckpointError, EpisodesFailedError, PolicyFailedError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.extract.sources.player import LONGEST_TRACEBACK, add_traceback, traceback_of
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.hooks.family import Family
from probe_kit.runs import open_run
from probe_kit.suite import Suite, build_suite

CALLS_BEFORE = 2
"""Inferences that go well: the first is made twice, with hooks and without."""


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suite") / "two", ["color"], 2)


def settings(suite: Suite) -> ExtractSettings:
    return ExtractSettings(
        "pi0-tiny",
        random_weights=True,
        suite=suite.folder,
        scene=SceneSpec(max_steps=2),
        env_workers=0,
        frames="none",
    )


def leave(_: Any) -> Any:
    sys.exit(0)


def fall(_: Any) -> Any:
    raise KeyError("no such thing")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (leave, r"PolicyFailedError: pi0-tiny failed while it acted: it called sys.exit\(0\)"),
        (fall, "PolicyFailedError: pi0-tiny failed while it acted: KeyError: 'no such thing'"),
        (lambda chunks: chunks * np.nan, r"ActionError: action .* is not finite \(NaN or infinity\)"),
        pytest.param(
            lambda _: None,
            "PolicyFailedError: the policy gave a NoneType for 1 observations",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda chunks: chunks[:, :, :6],
            r"PolicyFailedError: the policy gave a ndarray of shape \(1, \d+, 6\)",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda chunks: chunks[0],
            "PolicyFailedError: the policy gave a ndarray of shape",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["exit", "error", "NaN", "None", "too short", "no batch"],
)
def test_what_a_policy_does_wrong_gives_its_episodes_up_by_name(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: Any, words: str
) -> None:
    act, calls = Pi0.act, iter(range(1000))

    def spoiled(self: Pi0, *arguments: Any) -> Any:
        chunks = act(self, *arguments)
        return chunks if next(calls) < CALLS_BEFORE else spoil(chunks)

    monkeypatch.setattr(Pi0, "act", spoiled)
    with pytest.raises(EpisodesFailedError) as caught:
        extract_run(settings(suite), tmp_path / "run")
    assert len(caught.value.__notes__) == 3
    from re import search

    assert all(search(words, note) for note in caught.value.__notes__), caught.value.__notes__
    assert all("a2a-embedded-color" in note for note in caught.value.__notes__)
    assert len(open_run(tmp_path / "run", allow_partial=True).episodes) == 1


def test_a_failure_is_stored_with_the_traceback_of_the_policys_own_code(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    act, calls = Pi0.act, iter(range(1000))
    monkeypatch.setattr(
        Pi0, "act", lambda *args: (fall if next(calls) >= CALLS_BEFORE else lambda a: act(*a))(args)
    )
    with pytest.raises(EpisodesFailedError) as caught:
        extract_run(settings(suite), tmp_path / "run")
    files = sorted((tmp_path / "run" / "failed").iterdir())
    assert len(files) == 3
    for file, note in zip(files, caught.value.__notes__, strict=True):
        assert str(file) in note
        record = json.loads(file.read_text(encoding="utf-8"))
        assert "in fall\n" in record["traceback"]
        assert record["traceback"].rstrip().endswith(record["reason"].split(": ", 1)[1])
        assert record["reason"] in open_run(tmp_path / "run", allow_partial=True).failed.values()


def test_an_error_of_another_process_keeps_the_traceback_of_that_process() -> None:
    try:
        raise ActionError("out of bounds")
    except ActionError as error:
        add_traceback(error)
        received = pickle.loads(pickle.dumps(error))
    assert received.__traceback__ is None
    assert "test_foreign_policies.py" in traceback_of(received)
    assert len(traceback_of(ActionError("x" * 100_000))) == LONGEST_TRACEBACK


def exiting_loader(*_: Any) -> Any:
    sys.exit(0)


def raising_loader(*_: Any) -> Any:
    return {}["hidden_size"]


@pytest.mark.parametrize(
    ("loader", "error", "words"),
    [
        ("exiting_loader", PolicyFailedError, r"mine cannot be loaded: its code called sys.exit\(0\)"),
        ("raising_loader", CheckpointError, "mine cannot be loaded from what it brings: KeyError: 'hidden_size'"),
        ("no_loader", CheckpointError, "mine cannot be loaded from .*AttributeError"),
    ],
)
def test_a_family_that_cannot_load_says_so_by_name(loader: str, error: type[Exception], words: str) -> None:
    module = sys.modules[__name__]
    sys.modules["their_family"] = module
    family = Family("mine", "theirs", None, f"their_family:{loader}")
    try:
        with pytest.raises(error, match=words):
            family.load(None)
    finally:
        del sys.modules["their_family"]


def test_a_family_that_is_wrong_about_itself_breaks_no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    from probe_kit.extract.inspect_commands import _model_rows
    from probe_kit.hooks import registry

    broken = Family("mine", "theirs", None, "x:y", packages=(("nowhere.at.all", "extra"),))
    entry = SimpleNamespace(name="mine", value="x:y", load=lambda: broken, dist=None)
    monkeypatch.setattr(registry, "family_entries", lambda: [entry])
    (row,) = _model_rows("mine")
    assert "unknown: " in row["ready"]
    rows = {row["model"]: row["ready"] for row in _model_rows(None)}
    assert rows["mine"] == "?"
    assert rows["pi0-tiny"] == "yes"
