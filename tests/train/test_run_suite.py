"""The suite of a run is found without being named, and a control without it is never left out in silence."""

import shutil
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import SuiteError, SuiteNotFoundError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.extract.extraction import open_checked
from probe_kit.runs import Run, open_run, seal
from probe_kit.runs.run_suite import suite_of
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import Suite, build_suite
from probe_kit.suite.build import default_folder
from probe_kit.suite.items import Wording
from probe_kit.train import ArrayRun, train_probes
from tests.support.changed_suites import CHANGES, other_name, save_changed
from tests.support.little_run import STREAMS, certify, episode, little_settings, suite_record
from tests.support.plans import make_plan

SHORT = SceneSpec(max_steps=2)
CONTROL_LEFT_OUT = "the controls random-features and pixels are on by default and NOT run"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty one."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("PROBE_KIT_CACHE", str(folder))
    return folder


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache that holds what `extract --categories color` draws."""
    folder = tmp_path_factory.mktemp("drawn") / "cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PROBE_KIT_CACHE", str(folder))
        extracted_suite()
    return folder


@pytest.fixture
def filled(cache: Path, drawn: Path) -> Path:
    """The cache as `extract` left it."""
    return Path(shutil.copytree(drawn, cache))


def extracted_suite(items: int | None = None) -> Suite:
    """What `extract --categories color --items ITEMS` runs on."""
    settings = ExtractSettings("expert", scene=SHORT, categories=("color",), items=items)
    suite = open_checked(settings)[1].suite
    assert suite is not None
    return suite


def run_on(
    suite: Suite,
    where: Path,
    episodes: int | None = None,
    wordings: Sequence[Wording] | None = None,
    calls: int = 1,
) -> Run:
    """A run without a model, of which the first `episodes` are there, each with one of `calls` inferences."""
    plan = make_plan(suite, list(STREAMS), 0, calls, True, wordings)
    settings = {**little_settings(), "suite": suite_record(suite), "captured_calls": calls}
    if wordings is not None:
        settings["wordings"] = plan.selection["wordings"]
    writer = RunWriter(locate(where), plan, settings)
    certify(writer)
    for number in writer.remaining()[:episodes]:
        record = episode(plan, number)
        arrays = {
            kind: {name: repeated(values, calls) for name, values in of.items()}
            for kind, of in record.arrays.items()
        }
        writer.write(replace(record, arrays=arrays))
    if episodes is None:
        seal(where)
    return open_run(where, allow_partial=True)


def repeated(array: NDArray[np.generic], times: int) -> NDArray[np.generic]:
    return np.repeat(array, times, axis=0)


@pytest.mark.parametrize("items", [pytest.param(None, marks=pytest.mark.slow), 12])
@pytest.mark.parametrize(
    "emptied",
    [True, pytest.param(False, marks=pytest.mark.slow)],
    ids=["cache emptied since", "cache as extract left it"],
)
def test_what_extract_drew_is_drawn_again_or_found(
    items: int | None, emptied: bool, filled: Path, tmp_path: Path
) -> None:
    suite = extracted_suite(items)
    run = run_on(suite, tmp_path / "run", episodes=2)
    if emptied:
        shutil.rmtree(filled)
    drawn_suite = suite_of(run)
    assert drawn_suite.identity == suite.identity == run.suite
    assert not default_folder().exists()  # eleven categories would take half a minute
    assert all(item.picture("left").is_file() for item in drawn_suite.items)
    assert suite_of(run).folder == drawn_suite.folder


@pytest.mark.usefixtures("cache")
def test_a_suite_of_fewer_items_that_was_built_elsewhere_is_drawn_again(tmp_path: Path) -> None:
    suite = build_suite(tmp_path / "suite", ["shape", "color"], 4)
    run = run_on(suite, tmp_path / "run", episodes=1)
    shutil.rmtree(suite.folder)
    assert suite_of(run).content_sha256 == suite.content_sha256


@pytest.mark.slow
@pytest.mark.usefixtures("cache")
def test_a_run_is_told_by_all_that_it_was_to_have_whatever_is_left_of_it(tmp_path: Path) -> None:
    """Unfinished, and in a wording that not every item has."""
    suite = build_suite(tmp_path / "suite", ["state", "color"], 4)
    part = suite.select(["state", "color"], 2)
    unfinished = run_on(part, tmp_path / "unfinished", episodes=1)
    worded = run_on(part, tmp_path / "worded", wordings=("knowledge", "named")).in_wording("named")
    assert worded.episodes["item_id"].nunique() < len(part.items)
    for run in (unfinished, worded):
        assert suite_of(run, suite.folder) == suite
        assert suite_of(run).items == part.items


@pytest.mark.slow
def test_the_folder_of_the_extraction_is_found_from_anywhere_as_long_as_it_holds_the_suite(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = build_suite(tmp_path / "mine", ["color"], 4, seed=3)
    monkeypatch.chdir(tmp_path)
    settings = ExtractSettings("expert", scene=SHORT, suite=Path("mine"), items=2, env_workers=0, frames="none")
    run = extract_run(settings, tmp_path / "run")
    monkeypatch.chdir("/")
    assert suite_of(open_run(run.path)) == suite
    shutil.rmtree(suite.folder)
    with pytest.raises(SuiteNotFoundError, match=r"drawn again.*--suite.*mine of its extraction is gone"):
        suite_of(run)
    build_suite(tmp_path / "mine", ["color"], 4, seed=4)
    with pytest.raises(SuiteNotFoundError, match=r"mine of its extraction no longer holds it.*hash to"):
        suite_of(run)
    assert cache.is_dir()  # the pictures of the embedded suite were drawn and found to be others


REFUSED = {
    "another seed": ({"seed": 1}, None, "drawn with another seed"),
    "a suite of one's own": ({}, "mine", "extracted from mine@2"),
}


@pytest.mark.slow
@pytest.mark.usefixtures("filled")
@pytest.mark.parametrize(("drawing", "name", "reason"), REFUSED.values(), ids=REFUSED)
def test_a_default_control_without_its_pictures_is_said_aloud_and_one_that_was_asked_for_is_an_error(
    drawing: dict[str, int], name: str | None, reason: str, tmp_path: Path
) -> None:
    built = build_suite(tmp_path / "suite", ["color"], 12, **drawing)
    suite = built if name is None else save_changed(other_name(built), tmp_path / name)
    run = run_on(suite, tmp_path / "run")
    with pytest.warns(UserWarning, match=f"{CONTROL_LEFT_OUT}.*{reason}.*--suite, suite=.*controls=\\(\\)"):
        assert train_probes(run, permutations=1).scores["exceeds_random_features"].isna().all()
    for control in ("random-features", "pixels"):
        with pytest.raises(SuiteNotFoundError, match=f"{reason}.*--suite, suite="):
            train_probes(run, permutations=1, controls=(control,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train_probes(run, permutations=1, controls=())
        results = train_probes(run, permutations=1, suite=suite.folder)
    assert results.scores["exceeds_random_features"].notna().all()


@pytest.mark.slow
def test_the_same_control_is_the_default_in_python_and_on_the_command_line(filled: Path, tmp_path: Path) -> None:
    runs = [run_on(extracted_suite(12), tmp_path / name) for name in ("python", "command")]
    shutil.rmtree(filled)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        by_python = train_probes(runs[0], permutations=1)
    shutil.rmtree(filled)
    answer = CliRunner().invoke(app, ["train", str(runs[1].location), "--permutations", "1"])
    assert answer.exit_code == 0, answer.stderr
    assert "chance only" not in answer.stderr
    by_command = train_probes(runs[1], permutations=1, controls=())  # loaded
    assert by_python.scores["exceeds_random_features"].notna().all()
    assert by_python.controls == by_command.controls


@pytest.mark.slow
@pytest.mark.usefixtures("cache")
def test_a_control_that_is_stored_needs_no_pictures_again(tmp_path: Path) -> None:
    suite = build_suite(tmp_path / "suite", ["color"], 12, seed=1)
    run = run_on(suite, tmp_path / "run")
    first = train_probes(run, permutations=1, suite=suite.folder)
    shutil.rmtree(suite.folder)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert train_probes(run, permutations=1).controls == first.controls


@pytest.mark.usefixtures("cache")
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_the_same_questions_with_other_twins_or_another_version_are_another_suite(
    change: Callable[[Suite], Suite], tmp_path: Path
) -> None:
    suite = build_suite(tmp_path / "suite", ["color"], 4)
    run = run_on(suite.select(None, 2), tmp_path / "run", episodes=1)
    changed = save_changed(change(suite), tmp_path / "changed")
    assert suite_of(run, suite.folder) == suite
    with pytest.raises(SuiteError, match="Give that suite's folder"):
        suite_of(run, changed.folder)


@pytest.mark.slow
@pytest.mark.usefixtures("filled")
def test_a_damaged_suite_in_the_cache_and_another_suite_are_errors(tmp_path: Path) -> None:
    suite = extracted_suite()
    run = run_on(suite.select(None, 12), tmp_path / "run")
    with pytest.raises(SuiteError, match="Give that suite's folder"):
        train_probes(run, permutations=1, suite=build_suite(tmp_path / "other", ["color"], 2, seed=5).folder)
    suite.items[-1].picture("left").write_bytes(b"")
    with pytest.raises(SuiteError, match="delete the folder"):
        train_probes(run, permutations=1)


@pytest.mark.slow
def test_a_cache_that_cannot_be_written_is_named_as_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_on(build_suite(tmp_path / "suite", ["color"], 12), tmp_path / "run")
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match=f"{CONTROL_LEFT_OUT}.*PROBE_KIT_CACHE"):
        train_probes(run, permutations=1)


def test_features_from_elsewhere_are_probed_with_the_same_warning(planted_run: Callable[..., ArrayRun]) -> None:
    with pytest.warns(UserWarning, match=f"{CONTROL_LEFT_OUT}.*noise@1"):
        train_probes(planted_run(), permutations=1)
