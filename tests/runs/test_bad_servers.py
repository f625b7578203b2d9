"""Object stores that are busy, slow, away, or lie: the same bytes in the end, or one clear error and no commit."""

import itertools
import warnings
from collections.abc import Callable, Sequence
from datetime import timedelta
from functools import partial
from pathlib import Path
from threading import Thread, Timer
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import ProbeKitError, StoreError
from probe_kit.hooks import Site
from probe_kit.runs import Run, open_run, seal, verify_run
from probe_kit.runs import store as buckets
from probe_kit.runs.run import NotSealedWarning
from probe_kit.runs.store import locate
from probe_kit.suite import Suite
from probe_kit.train import load_results
from tests.runs.contents import objects
from tests.support.little_run import episode, little_plan, little_writer
from tests.support.s3_server import BadServer, now_and_then

EPISODES = 2
SITE = Site("expert", 0, iteration=1)
TRANSIENT = ("busy", "torn", "unanswered", "cut", "slow")


def write(run: Path | str, suite: Suite) -> Run:
    """What an extraction does with its episodes."""
    plan = little_plan(suite, episodes=EPISODES)
    writer = little_writer(locate(run), plan)
    with writer.owned():
        for number in writer.remaining():
            writer.write(episode(plan, number))
        seal(run)
    return open_run(run)


@pytest.fixture(scope="module")
def suite(small_suite: Suite) -> Suite:
    return small_suite.select(["color"])


@pytest.fixture(scope="module")
def in_folder(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return write(tmp_path_factory.mktemp("whole") / "run", suite)


@pytest.fixture(scope="module")
def whole(in_folder: Run) -> dict[str, bytes]:
    """The objects of a run in a folder."""
    return objects(in_folder.path)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Retries without the minute of pauses; a late answer is no failure."""
    monkeypatch.setattr(buckets, "PATIENCE", timedelta(seconds=1))
    monkeypatch.setattr(buckets, "_QUICK", timedelta(seconds=1))
    if "silent" in request.node.name:
        monkeypatch.setenv("AWS_TIMEOUT", "3s")


def every(count: int, ills: Sequence[str], method: str = "") -> Callable[[str, str], str | None]:
    """Every so many requests of this method have one of these, in turn; a repeated one has not."""
    asked, turns = itertools.count(1), itertools.cycle(ills)
    return lambda kind, _path: next(turns) if kind.startswith(method) and next(asked) % count == 0 else None


def test_what_a_server_does_now_and_then_changes_no_byte(
    suite: Suite, whole: dict[str, bytes], bad_server: BadServer
) -> None:
    open_nothing(bad_server)
    bad_server.day.ail = every(13, TRANSIENT)
    write(f"{bad_server.url}/run", suite)
    assert set(bad_server.day.seen) == set(TRANSIENT)
    bad_server.day.ail = lambda *_: None
    assert objects(f"{bad_server.url}/run") == whole


def open_nothing(server: BadServer) -> None:
    """A first request that is answered."""
    assert not locate(f"{server.url}/run").exists("run.json")


@pytest.mark.slow
def test_requests_that_nobody_answers_are_repeated(
    suite: Suite, whole: dict[str, bytes], bad_server: BadServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_TIMEOUT", "500ms")
    run = f"{bad_server.url}/run"
    bad_server.day.ail = every(7, ["silent"], "PUT")
    write(run, suite)
    bad_server.day.ail = lambda *_: None
    assert bad_server.day.seen["silent"] > 0
    assert objects(run) == whole


@pytest.mark.slow
@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(
    "ill", ["busy", *(pytest.param(ill, marks=pytest.mark.slow) for ill in ("torn", "unanswered", "silent"))]
)
def test_a_server_that_stays_bad_is_one_error_and_the_same_command_continues(
    ill: str, suite: Suite, whole: dict[str, bytes], bad_server: BadServer
) -> None:
    run = f"{bad_server.url}/run"
    committed = [0]

    def ail(method: str, path: str) -> str | None:
        committed[0] += method == "PUT" and "/commits/" in path
        return ill if committed[0] >= 2 else None

    bad_server.day.ail = ail
    with pytest.raises(StoreError, match=r"cannot be used.*the same command continues") as caught:
        write(run, suite)
    assert caught.value.exit_code == 3
    bad_server.day.ail = lambda *_: None
    assert verify_run(run, deep=True).ok
    assert verify_run(run).committed == (2 if ill == "unanswered" else 1)
    write(run, suite)
    assert objects(run) == whole


@pytest.mark.slow
def test_a_server_that_dies_and_returns_is_waited_for(
    suite: Suite, whole: dict[str, bytes], bad_server: BadServer
) -> None:
    run = f"{bad_server.url}/run"
    plan = little_plan(suite, episodes=EPISODES)
    writer = little_writer(locate(run), plan)
    for number in writer.remaining():
        bad_server.stop()
        Timer(0.2, bad_server.start).start()
        writer.write(episode(plan, number))
    seal(run)
    assert objects(run) == whole


@pytest.fixture
def kept(little_runs: Path, bad_server: BadServer) -> Run:
    """A run with probes on a server that was well when it was made."""
    here, there = locate(little_runs / "run"), locate(f"{bad_server.url}/run")
    for key in here.keys(""):
        there.write(key, here.read(key))
    return open_run(there)


@pytest.mark.slow
@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("ill", ["busy", pytest.param("silent", marks=pytest.mark.slow)])
def test_reading_from_a_server_that_fails_says_what_to_do(ill: str, kept: Run, bad_server: BadServer) -> None:
    asks: tuple[Callable[[], object], ...] = (
        partial(kept.column, SITE, "mean"),
        partial(kept.rows("expert", "tokens").__getitem__, 1),
        lambda: kept.xarray()["expert"].values,
        partial(load_results, kept),
        partial(verify_run, kept.location, deep=True),
        partial(open_run, str(kept.location)),
    )
    bad_server.day.ail = lambda *_: ill
    for ask in asks:
        with pytest.raises(StoreError, match="cannot be used"):
            ask()


@pytest.mark.slow
def test_reading_from_a_server_on_a_bad_day_gives_the_same_numbers(kept: Run, bad_server: BadServer) -> None:
    column, tokens = kept.column(SITE, "mean"), kept.rows("expert", "tokens")[1]
    scores = load_results(kept).scores
    bad_server.day.ail = now_and_then(("busy", "torn", "unanswered", "cut"), 0.3, seed=1)
    again = open_run(kept.location)
    np.testing.assert_array_equal(again.column(SITE, "mean"), column)
    np.testing.assert_array_equal(again.rows("expert", "tokens")[1], tokens)
    assert load_results(again).scores.equals(scores)
    assert verify_run(kept.location, deep=True).ok
    assert bad_server.day.seen.total() > 5


@pytest.mark.slow
@pytest.mark.usefixtures("impatient")
def test_a_store_that_never_answered_is_given_up_soon(bad_server: BadServer) -> None:
    bad_server.stop()
    try:
        found = CliRunner().invoke(app, ["run", "show", f"{bad_server.url}/run"])
    finally:
        bad_server.start()
    assert isinstance(found.exception, StoreError) or found.exit_code == 3, found.output


@pytest.mark.parametrize("where", ["folder", pytest.param("bucket", marks=pytest.mark.slow)])
def test_who_reads_while_another_writes_sees_whole_episodes_only(
    where: str, suite: Suite, in_folder: Run, whole: dict[str, bytes], tmp_path: Path, request: Any
) -> None:
    run = f"{request.getfixturevalue('bucket')}/run" if where == "bucket" else str(tmp_path / "run")
    expected = in_folder.rows("expert", "tokens")
    little_writer(locate(run), little_plan(suite, episodes=EPISODES))
    writing = Thread(target=write, args=(run, suite), daemon=True)
    writing.start()
    seen, alive = set[int](), True
    while alive:
        alive = writing.is_alive()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotSealedWarning)
            opened = open_run(run, allow_partial=True)
            seen.add(len(opened.episodes))
            if len(opened.episodes):
                assert opened.column(SITE, "mean").shape == (len(opened.episodes), 4)
        for row, number in enumerate(opened.episodes["episode"]):
            np.testing.assert_array_equal(opened.rows("expert", "tokens")[row], expected[number])
        assert verify_run(run, deep=True).problems == ()
    assert EPISODES in seen
    assert objects(run) == whole


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_a_third_of_all_requests_failing_changes_no_byte(
    seed: int, suite: Suite, whole: dict[str, bytes], bad_server: BadServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However often the command must be given."""
    monkeypatch.setenv("AWS_TIMEOUT", "1s")
    run = f"{bad_server.url}/run"
    open_nothing(bad_server)
    bad_server.day.ail = now_and_then((*TRANSIENT, "silent"), 0.33, seed)
    errors = []
    for _ in range(100):
        try:
            write(run, suite)
            break
        except ProbeKitError as error:
            errors.append(str(error))
    bad_server.day.ail = lambda *_: None
    print(f"seed {seed}: {dict(bad_server.day.seen)}, {len(errors)} errors")
    assert objects(run) == whole
