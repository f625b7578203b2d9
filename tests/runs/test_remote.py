"""Runs in an object store: the same bytes as in a folder, and the same promises."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import RunDamagedError, RunNotFoundError, SettingsMismatchError, StoreError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.hooks import Site
from probe_kit.runs import Run, open_run, seal, verify_run
from probe_kit.runs.layout import COLUMNS
from probe_kit.runs.store import Location, check_exclusive, locate
from probe_kit.suite import Suite, build_suite
from probe_kit.train import load_results, train_probes
from tests.runs.contents import objects

ROOT = Path(__file__).parents[2]
KILLING = ("-m", "tests.runs.killing")
SHORT = SceneSpec(max_steps=2)
SITE = Site("expert", 1, iteration=3)


def start(run: str | Path, suite: Suite, *point: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, *KILLING, str(run), str(suite.folder), *point], cwd=ROOT)


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suite") / "six", ["color"], 6)


@pytest.fixture(scope="module")
def whole(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Synthetic episodes in a folder."""
    run = tmp_path_factory.mktemp("whole") / "run"
    assert start(run, suite).wait() == 0
    return run


def copy_to(bucket: str, here: Location) -> Run:
    """The run without its probes in a bucket, sealed there."""
    there = locate(f"{bucket}/run")
    for key in here.keys(""):
        if not key.startswith((COLUMNS, "probes", "interventions")):
            there.write(key, here.read(key))
    assert seal(there)
    return open_run(there)


@pytest.fixture
def copied(recorded_run: Run, bucket: str) -> Run:
    """A real run, with all tokens, in a bucket."""
    return copy_to(bucket, recorded_run.location)


@pytest.mark.slow
def test_a_run_in_a_bucket_has_the_same_bytes_as_one_in_a_folder(
    suite: Suite, tmp_path: Path, bucket: str
) -> None:
    settings = ExtractSettings("pi0-tiny", suite=suite.folder, items=2, scene=SHORT, tokens="all", env_workers=0)
    local = extract_run(settings, tmp_path / "run")
    remote = extract_run(settings, f"{bucket}/prefix/run")
    assert (remote.stamp, remote.settings_sha256, remote.sealed) == (local.stamp, local.settings_sha256, True)
    there, here = (
        {key: content for key, content in objects(place).items() if not key.startswith("times/")}
        for place in (f"{bucket}/prefix/run", tmp_path / "run")
    )
    assert there == here


@pytest.mark.slow
def test_three_writers_at_once_give_the_same_store_in_a_bucket(suite: Suite, whole: Path, bucket: str) -> None:
    run = f"{bucket}/run"
    writers = [start(run, suite) for _ in range(3)]
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    assert objects(run) == objects(whole)


@pytest.mark.slow
def test_worker_processes_share_a_bucket(suite: Suite, tmp_path: Path, bucket: str) -> None:
    settings = ExtractSettings("expert", suite=suite.folder, scene=SHORT, env_workers=0)
    alone = extract_run(settings, tmp_path / "run")
    together = extract_run(settings.changed(workers=2), f"{bucket}/run")
    assert together.stamp == alone.stamp


@pytest.mark.slow
def test_other_settings_are_refused_in_a_bucket_too(suite: Suite, bucket: str) -> None:
    settings = ExtractSettings("expert", suite=suite.folder, items=2, scene=SHORT)
    extract_run(settings, f"{bucket}/run")
    with pytest.raises(SettingsMismatchError, match=r"seed: stored 0, asked 1"):
        extract_run(settings.changed(seed=1), f"{bucket}/run")


@pytest.mark.parametrize("workers", [1, 2])
def test_a_store_that_ignores_conditions_is_refused_before_a_run_is_begun(
    suite: Suite, deaf_bucket: str, workers: int
) -> None:
    settings = ExtractSettings("expert", suite=suite.folder, items=2, scene=SHORT, workers=workers)
    with pytest.raises(StoreError, match=r"ignores conditional puts.*Use another store, or a folder"):
        extract_run(settings, f"{deaf_bucket}/run")
    assert not locate(f"{deaf_bucket}/run").exists("run.json")


def test_a_run_is_not_continued_in_a_store_that_ignores_conditions(whole: Path, deaf_bucket: str) -> None:
    here, there = locate(whole), locate(f"{deaf_bucket}/run")
    for key in here.keys(""):
        there.write(key, here.read(key))
    with pytest.raises(StoreError, match=r"created run\.json a second time"):
        check_exclusive(there, "run.json")
    check_exclusive(here, "run.json")


@pytest.mark.slow
def test_numbers_and_probes_of_a_bucket_are_those_of_a_folder(recorded_run: Run, copied: Run) -> None:
    assert copied.sealed
    np.testing.assert_array_equal(copied.column(SITE), recorded_run.column(SITE))
    for ours, theirs in zip(copied.tokens(SITE), recorded_run.tokens(SITE), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert copied.xarray().sizes == recorded_run.xarray().sizes
    chosen = {"categories": ["color"], "views": ["mean"], "permutations": 0}
    results = train_probes(copied, **chosen)
    expected = train_probes(recorded_run, **chosen)
    again = load_results(open_run(copied.location))
    assert again.key == results.key == expected.key
    np.testing.assert_array_equal(again.scores["accuracy"], expected.scores["accuracy"])
    place = next(iter(expected.directions))
    np.testing.assert_array_equal(again.directions[place].weights, expected.directions[place].weights)


def flip_a_bit(location: Location, key: str) -> None:
    content = bytearray(location.read(key))
    content[len(content) // 2] ^= 1
    location.write(key, bytes(content))


@pytest.mark.slow
def test_damage_in_a_bucket_is_found_and_never_read_as_numbers(little_runs: Path, bucket: str) -> None:
    copied = copy_to(bucket, locate(little_runs / "run"))
    shard = next(key for key in copied.location.keys("data.zarr/expert/tokens") if "/c/7/" in key)
    flip_a_bit(copied.location, shard)
    assert verify_run(copied.location).ok
    (problem,) = verify_run(copied.location, deep=True).problems
    assert shard in problem
    with pytest.raises(RunDamagedError):
        copied.rows("expert", "tokens")[7]
    copied.location.remove(shard.rpartition("/")[0])
    with pytest.raises(RunDamagedError, match="is missing"):
        open_run(copied.location)


@pytest.mark.slow
def test_the_commands_take_urls(copied: Run, tmp_path: Path, bucket: str) -> None:
    def probe_kit(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "probe_kit", *arguments]
        return subprocess.run(command, capture_output=True, encoding="utf-8", check=False, cwd=tmp_path)

    run = str(copied.location)
    made = probe_kit("extract", "--model", "expert", "--categories", "color", "--items", "2", "--max-steps", "2",
                     "--out", f"{bucket}/scripted")  # fmt: skip
    assert (made.returncode, made.stdout.strip()) == (0, f"{bucket}/scripted"), made.stderr
    assert f"probe-kit retention {bucket}/scripted" in made.stderr
    verified = probe_kit("run", "verify", run, "--deep")
    assert (verified.returncode, "sealed; every byte checked" in verified.stdout) == (0, True), verified.stderr
    assert "nothing to seal" in probe_kit("run", "verify", run, "--seal").stderr
    assert probe_kit("run", "export", run, "--format", "safetensors").returncode == 0
    assert {path.name for path in tmp_path.iterdir()} >= {"run.safetensors", "run.safetensors.sha256"}
    table = probe_kit("retention", f"{bucket}/scripted", "--format", "json")
    assert (table.returncode, f"{bucket}/scripted" in table.stdout) == (0, True), table.stderr


def test_a_url_without_a_run_is_named(bucket: str) -> None:
    with pytest.raises(RunNotFoundError, match=f"{bucket}/nothing is not a run"):
        open_run(f"{bucket}/nothing")


@pytest.mark.usefixtures("bucket")
def test_a_bucket_that_is_not_there_is_named() -> None:
    with pytest.raises(StoreError, match="there is no bucket 'no-such-bucket-anywhere'"):
        open_run("s3://no-such-bucket-anywhere/run")
    with pytest.raises(StoreError, match="there is no bucket 'no-such-bucket-anywhere'"):
        locate("s3://no-such-bucket-anywhere/run").create("run.json", b"{}")


def test_missing_credentials_are_named_and_not_the_address_that_was_asked_for_them() -> None:
    from obstore.exceptions import GenericError

    asked = "Error performing PUT http://169.254.169.254/latest/api/token in 23ms - Server returned 403"
    with (
        pytest.raises(StoreError, match=r"no credentials.*AWS_ACCESS_KEY_ID") as caught,
        locate("s3://b/r").in_words(),
    ):
        raise GenericError(asked)
    assert "169.254" not in str(caught.value)
