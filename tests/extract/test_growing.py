"""`extract` and `ask` with more items play what is missing and keep the rest."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import SettingsMismatchError
from probe_kit.extract import AskSettings, ExtractSettings, ask_run, extract_run, prepare
from probe_kit.extract.prompts import find_template
from probe_kit.runs import Run, label_run, open_run, verify_run
from probe_kit.suite import Suite

pytestmark = pytest.mark.slow


def scripted(suite: Suite, items: int, **more: Any) -> ExtractSettings:
    return ExtractSettings(
        "idle", suite=suite.folder, categories=("color",), items=items, scene=SceneSpec(max_steps=2),
        env_workers=0, **more,
    )  # fmt: skip


def bytes_of(run: Path) -> dict[str, bytes]:
    """Of all that growing may not change."""
    files = {path.relative_to(run).as_posix(): path.read_bytes() for path in run.rglob("*") if path.is_file()}
    return {
        name: content
        for name, content in files.items()
        if not name.startswith(("columns.zarr", "sealed")) and not name.endswith("zarr.json")
    }


def assert_grew(before: dict[str, bytes], grown: Run, at_once: Run) -> None:
    after = bytes_of(grown.path)
    assert {name: after[name] for name in before} == before
    assert (grown.path / "run.json").read_bytes() == (at_once.path / "run.json").read_bytes()
    per_run_columns = ["episode", "seconds_inference", "seconds_simulation"]
    assert grown.episodes.drop(columns=per_run_columns).equals(at_once.episodes.drop(columns=per_run_columns))
    for stream in at_once.streams:
        for site in at_once.sites(stream):
            for view in at_once.views(stream):
                np.testing.assert_array_equal(grown.column(site, view), at_once.column(site, view))
    assert verify_run(grown.path, deep=True).finished


def test_extract_plays_the_missing_items_only(small_suite: Suite, tmp_path: Path) -> None:
    played: list[tuple[int, int]] = []
    extract_run(scripted(small_suite, 2), tmp_path / "run")
    before = bytes_of(tmp_path / "run")
    grown = extract_run(
        scripted(small_suite, 4), tmp_path / "run", lambda finished, of, _: played.append((finished, of))
    )
    assert played == [(number, 8) for number in (5, 6, 7, 8)]
    assert_grew(before, grown, extract_run(scripted(small_suite, 4), tmp_path / "at_once"))
    again = extract_run(scripted(small_suite, 2), tmp_path / "run", lambda *_: played.append((0, 0)))
    assert (len(again.episodes), len(played)) == (8, 4)


def test_a_policy_gives_in_a_grown_run_what_it_gives_at_once(small_suite: Suite, tmp_path: Path) -> None:
    settings = ExtractSettings(
        "pi0-tiny", random_weights=True, suite=small_suite.folder, categories=("color",), items=2,
        scene=SceneSpec(max_steps=4), tokens="all",
    )  # fmt: skip
    extract_run(settings, tmp_path / "run")
    before, more = bytes_of(tmp_path / "run"), settings.changed(categories=("color", "shape"))
    assert_grew(before, extract_run(more, tmp_path / "run"), extract_run(more, tmp_path / "at_once"))
    grown = open_run(tmp_path / "run")
    site = grown.sites("backbone")[-1]
    np.testing.assert_array_equal(grown.tokens(site)[0], open_run(tmp_path / "at_once").tokens(site)[0])


@pytest.mark.parametrize("query", ["target", "absent"])
def test_an_asked_run_grows_too(query: Any, small_suite: Suite, tmp_path: Path) -> None:
    prompt = AskSettings(
        "vlm-tiny", prompt=find_template("seen"), picture_size=(224, 224), random_weights=True,
        suite=small_suite.folder, categories=("color",), items=2, query=query, tokens="pooled",
    )  # fmt: skip
    ask_run(prompt, tmp_path / "run")
    before, more = bytes_of(tmp_path / "run"), prompt.changed(items=6)
    assert_grew(before, ask_run(more, tmp_path / "run"), ask_run(more, tmp_path / "at_once"))


def test_two_workers_let_a_run_grow(small_suite: Suite, tmp_path: Path) -> None:
    extract_run(scripted(small_suite, 2), tmp_path / "run")
    before = bytes_of(tmp_path / "run")
    grown = extract_run(scripted(small_suite, 4, workers=2), tmp_path / "run")
    assert_grew(before, grown, extract_run(scripted(small_suite, 4), tmp_path / "at_once"))


def test_more_items_find_the_run_without_an_out_and_other_categories_do_not(small_suite: Suite) -> None:
    names = [prepare(scripted(small_suite, items)).default_name() for items in (2, 4)]
    other = prepare(scripted(small_suite, 2).changed(categories=("shape",))).default_name()
    assert names[0] == names[1] != other


def test_a_label_is_kept_while_a_run_grows_and_is_no_part_of_its_identity(
    small_suite: Suite, tmp_path: Path
) -> None:
    first = extract_run(scripted(small_suite, 2, label="mine"), tmp_path / "run")
    label_run(first.path, "yours")
    grown = extract_run(scripted(small_suite, 4), tmp_path / "run")
    assert (grown.label, grown.root.identity) == ("yours", first.root.identity)


def test_the_command_names_what_grows_what_is_stale_and_what_never_shrinks(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    where = str(tmp_path / "run")
    command = ["extract", "--model", "idle", "--suite", str(small_suite.folder), "--categories", "color",
               "--max-steps", "2", "--env-workers", "0", "--out", where]  # fmt: skip

    def dry_run_text(*more: str) -> str:
        answer = CliRunner().invoke(app, [*command, *more])
        assert answer.exit_code == 0, answer.output
        return " ".join(answer.output.split())

    assert "grows" not in dry_run_text("--items", "2")
    assert "grows from 4 to 8 episodes; stored ones stay as they are" in dry_run_text("--items", "4", "--dry-run")
    assert len(open_run(where).episodes) == 4
    assert "8 episodes: " in dry_run_text("--items", "4")
    assert "grows no: the run has 8 episodes, these 4 among them, and never shrinks" in dry_run_text(
        "--items", "2"
    )
    refused = CliRunner().invoke(app, [*command, "--items", "2", "--categories", "shape"])
    assert refused.exit_code == 3
    assert "never gets smaller" in " ".join(refused.output.split())


def test_another_selection_is_refused_before_a_model_is_loaded(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ExtractSettings(
        "pi0-tiny", random_weights=True, suite=small_suite.folder, categories=("color",), items=2,
        scene=SceneSpec(max_steps=1),
    )  # fmt: skip
    extract_run(settings, tmp_path / "run")

    def load_policy(*_: object, **__: object) -> None:
        raise AssertionError("a model was loaded")

    monkeypatch.setattr("probe_kit.hooks.load_policy", load_policy)
    with pytest.raises(SettingsMismatchError, match="never gets smaller"):
        extract_run(settings.changed(categories=("shape",)), tmp_path / "run")
