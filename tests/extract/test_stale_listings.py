"""Object stores whose listings lag behind, and torn objects of killed processes: right, or an error by name."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from probe_kit.errors import ProbeKitError
from probe_kit.hooks import Site
from probe_kit.intervene.store.answers import find_stored
from probe_kit.runs import Run, open_run, seal, verify_run
from probe_kit.runs.layout import COLUMNS
from probe_kit.runs.store import locate
from probe_kit.suite import Suite
from probe_kit.train import load_results
from probe_kit.train.results.store import read_probes
from tests.extract.contents import objects
from tests.support.little_run import episode, little_plan, little_writer
from tests.support.s3_server import BadServer

pytestmark = pytest.mark.slow

EPISODES = 3
SITE = Site("expert", 0, iteration=1)


@pytest.fixture(scope="module")
def suite(small_suite: Suite) -> Suite:
    return small_suite.select(["color"])


def write(run: Path | str, suite: Suite) -> Run:
    """What an extraction does, after an attempt in which an episode was given up."""
    plan = little_plan(suite, episodes=EPISODES)
    writer = little_writer(locate(run), plan)
    with writer.owned():
        for number in writer.remaining():
            writer.write(episode(plan, number))
        seal(run)
    return open_run(run)


def give_up_one(run: str, suite: Suite) -> None:
    """Leave the record of a failure, which the next attempt removes."""
    little_writer(locate(run), little_plan(suite, episodes=EPISODES)).give_up(1, "it fell")


@pytest.fixture(scope="module")
def whole(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return objects(write(tmp_path_factory.mktemp("whole") / "run", suite).path)


def stale(server: BadServer, lag: int) -> None:
    """From now on every listing misses so many of the newest keys, and shows deleted ones."""
    server.day.lag, server.day.ail = lag, lambda *_: "stale"


@pytest.mark.filterwarnings("ignore:.*is not sealed")
@pytest.mark.parametrize("lag", [1, *(pytest.param(lag, marks=pytest.mark.slow) for lag in (0, 2, 7, 30))])
def test_an_extraction_with_stale_listings_is_complete_or_says_what_is_missing(
    lag: int, suite: Suite, whole: dict[str, bytes], bad_server: BadServer
) -> None:
    run = f"{bad_server.url}/run"
    give_up_one(run, suite)
    stale(bad_server, lag)
    for ask in (write, write, lambda run, _: open_run(run, allow_partial=True).failed):
        with suppress(ProbeKitError):
            ask(run, suite)
    assert bad_server.day.seen["stale"] > 0
    bad_server.day.ail = lambda *_: None
    assert verify_run(run, deep=True).problems == ()
    write(run, suite)
    assert objects(run) == whole


@pytest.fixture
def kept(little_runs: Path, bad_server: BadServer) -> Run:
    """A run with probes and an intervention, its commits and results newest."""
    here, there = locate(little_runs / "run"), locate(f"{bad_server.url}/run")
    stamp = open_run(here).stamp
    for key in sorted(here.keys(""), key=lambda key: ("columns", "data", "commits", "probes").index(_kind(key))):
        there.write(key.replace(COLUMNS, there.derived(COLUMNS, stamp)), here.read(key))
    return open_run(there)


def _kind(key: str) -> str:
    top = key.partition("/")[0].partition(".")[0]
    return {"commits": "commits", "probes": "probes", "columns": "columns"}.get(top, "data")


RESULTS = 3
"""Which of `readings` reads probe results."""


def readings(run: Run) -> tuple[Callable[[], Any], ...]:
    """What is read of a run, each by itself and anew."""
    again = partial(open_run, run.location)
    return (
        lambda: again().column(SITE, "mean").tobytes(),
        lambda: again().rows("expert", "tokens")[1].tobytes(),
        lambda: again().episodes.to_csv(),
        lambda: load_results(again()).scores.to_csv(),
        lambda: find_stored(again()).outcomes().to_bytes(),
    )


@pytest.mark.filterwarnings("ignore:.*is not sealed")
@pytest.mark.parametrize("lag", [40, *(pytest.param(lag, marks=pytest.mark.slow) for lag in (1, 4, 10))])
def test_reading_with_stale_listings_gives_the_same_or_an_error_by_name(
    lag: int, kept: Run, bad_server: BadServer
) -> None:
    """Probes that a listing hides do not exist yet: older ones of the run are read."""
    expected = [{ask()} for ask in readings(kept)]
    expected[RESULTS] |= {load_results(kept, key).scores.to_csv() for key in read_probes(kept.location)}
    stale(bad_server, lag)
    for ask, right in zip(readings(kept), expected, strict=True):
        with suppress(ProbeKitError):
            assert ask() in right


@pytest.mark.parametrize("step", [8, pytest.param(1, marks=pytest.mark.slow)], ids=["an eighth", "all"])
def test_every_object_that_a_killed_process_left_torn_is_named_or_made_again(
    step: int, suite: Suite, whole: dict[str, bytes], bucket: str
) -> None:
    """It took half of an object, said that all was well, and the process was killed before it asked again."""
    run = locate(f"{bucket}/run")
    write(str(run), suite)
    named = 0
    torn = [key for key in run.keys("") if "/c/" not in key or key.endswith(("/c/1/0/0/0", "/c/1/0/0"))]
    for key in torn[::step]:
        content = run.read(key)
        run.write(key, content[: len(content) // 2])
        message = f"{key} is as it was"
        try:
            write(str(run), suite)
            if objects(run) != whole:
                message = " ".join(verify_run(run, deep=True).problems)
        except ProbeKitError as error:
            message = str(error)
        assert key in message, message
        named += run.read(key) != content
        run.write(key, content)
    assert named > 5 // step
