"""Stores that refuse: whatever a store answers to any call, nothing is lost and nothing is believed.

Every trial has a server on this machine that ends with its test, and a bounded number of requests. The table of
docs/notes/storage.md is what these tests assert.
"""

import itertools
import re
from collections.abc import Callable
from datetime import timedelta
from functools import partial
from pathlib import Path

import pytest

from probe_kit.errors import StoreError
from probe_kit.runs import open_run, seal, verify_run
from probe_kit.runs import store as buckets
from probe_kit.runs.layout import DIAGNOSES
from probe_kit.runs.results import read_bundle, write_bundle
from probe_kit.runs.store import Location, locate
from probe_kit.suite import Suite
from probe_kit.train import load_results, train_probes
from tests.runs.contents import objects
from tests.support.little_run import episode, intervene_on_little_run, little_plan, little_writer
from tests.support.s3_server import ANSWERS, CALLS, BadServer, Call

LARGE = bytes(range(256)) * (11 << 12)
"""Eleven MiB, which are uploaded in three parts."""
MULTIPART = ("begin", "part", "complete")
PUTS = ("put", "create")
KEY = "deadbeef0123"


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hardly any pauses, and no patience beyond a quarter of a second."""
    monkeypatch.setattr(buckets, "PATIENCE", timedelta(seconds=0.25))
    monkeypatch.setattr(buckets, "LONGEST_PAUSE", 0.02)
    monkeypatch.setattr(buckets, "FIRST_PAUSE", 0.01)


def first(answer: str, call: str, key: str = "", times: int | None = 1) -> Callable[[Call], str | None]:
    """The first calls of a kind, to keys that a pattern matches, have this answer; None: all of them."""
    number = itertools.count(1)

    def attack(request: Call) -> str | None:
        matches = request.call == call and re.search(key, request.key)
        return answer if matches and (times is None or next(number) <= times) else None

    return attack


def ask(location: Location, call: str) -> object:
    """Make a call of this kind, in the way of the store."""
    if call in ("put", *MULTIPART):
        location.write("object", LARGE if call in MULTIPART else b"new")
        return None
    requests: dict[str, Callable[[], object]] = {
        "create": partial(location.create, "created", b"ours"),
        "get": partial(location.read, "kept"),
        "head": partial(location.exists, "kept"),
        "list": partial(location.keys, ""),
        "delete": partial(location.delete, "kept"),
    }
    return requests[call]()


def check_done(location: Location, call: str, answer: object) -> None:
    """The call did what it says."""
    expected = {"get": b"kept", "head": True, "list": ["kept", "object"]}
    assert answer == expected.get(call, answer)
    if call == "create":  # a reply that is lost leaves the object
        assert location.read("created") == b"ours"
    assert location.exists("kept") == (call != "delete")
    stored = {"put": b"new", **dict.fromkeys(MULTIPART, LARGE)}
    assert location.read("object") == stored.get(call, b"old")


def attacked(server: BadServer, call: str, answer: str, times: int | None) -> tuple[Location, object]:
    """A call that was answered so, and what came of it."""
    server.day.attack = lambda _call: None
    location = locate(f"{server.empty()}/run")
    for key, content in {"kept": b"kept", "object": b"old"}.items():
        location.write(key, content)
    server.day.seen.clear()
    server.day.attack = first(answer, call, times=times)
    try:
        return location, ask(location, call)
    finally:
        server.day.attack = lambda _call: None
        assert server.day.seen[answer]


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_one_bad_answer_to_any_call_changes_nothing(bad_server: BadServer) -> None:
    for call, answer in itertools.product(CALLS, ANSWERS):
        if call not in MULTIPART:
            check_done(*((attack := attacked(bad_server, call, answer, 1))[0], call, attack[1]))


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("call", MULTIPART)
def test_one_bad_answer_to_an_upload_in_parts_changes_nothing(bad_server: BadServer, call: str) -> None:
    for answer in ANSWERS:
        location, outcome = attacked(bad_server, call, answer, 1)
        check_done(location, call, outcome)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("answer", ["conflict", pytest.param("failed", marks=pytest.mark.slow)])
def test_a_call_that_is_refused_for_good_is_an_error_that_names_the_key(
    bad_server: BadServer, answer: str
) -> None:
    for call in ("put", "create", "get", "head", "delete"):
        with pytest.raises(StoreError) as caught:
            attacked(bad_server, call, answer, None)
        key = {"put": "object", "create": "created"}.get(call, "kept")
        assert re.search(rf"/run cannot be used: it refused {key} for 0 s, as if in use", str(caught.value))
        location = locate(f"{bad_server.url}/run")
        assert {key: location.read(key) for key in location.keys("")} == {"kept": b"kept", "object": b"old"}


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("call", CALLS)
def test_a_call_that_never_succeeds_is_an_error_and_no_half_object(bad_server: BadServer, call: str) -> None:
    for answer in ANSWERS:
        if answer == "cut" and call in ("put", "create", "part", "head"):
            continue  # the head of the reply is whole, and says that it was done
        with pytest.raises(StoreError, match="the same command continues"):
            attacked(bad_server, call, answer, None)
        location = locate(f"{bad_server.url}/run")
        contents = {key: location.read(key) for key in location.keys("")}
        assert contents.pop("kept", b"kept") == b"kept"
        assert contents.pop("object") in (b"old", b"new", LARGE)
        assert contents in ({}, {"created": b"ours"})


@pytest.mark.usefixtures("quick")
def test_an_object_of_another_writer_is_a_conflict_and_stays(bad_server: BadServer) -> None:
    for answer in ("conflict", "failed"):
        bad_server.day.attack = lambda _call: None
        location = locate(f"{bad_server.empty()}/run")
        location.write("commits/1.json", b"theirs")
        bad_server.day.attack = first(answer, "create", times=None)
        assert not location.create("commits/1.json", b"ours")
        assert location.read("commits/1.json") == b"theirs"


def test_a_panic_of_the_client_is_an_error_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    panic = type("PanicException", (BaseException,), {"__module__": "pyo3_runtime"})
    monkeypatch.setattr("obstore.head", lambda *_: (_ for _ in ()).throw(panic("called `unwrap()`\non an `Err`")))
    monkeypatch.setenv("AWS_REGION", "us-east-1")
    with pytest.raises(StoreError, match=r"^s3://b/run cannot be used: of run\.json: called .* on an `Err`.*$"):
        locate("s3://b/run").exists("run.json")


@pytest.mark.parametrize(
    ("name", "value"),
    [("AWS_ACCESS_KEY_ID", "key\n"), ("AWS_SESSION_TOKEN", "a\rb"), ("AWS_ENDPOINT_URL", ""),
     ("AWS_ENDPOINT_URL", "localhost:9000"), ("AWS_ENDPOINT", "not a url")],
)  # fmt: skip
def test_variables_that_end_the_client_are_refused_by_name(
    name: str, value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(StoreError, match=rf"the environment variable {name} "):
        locate("s3://b/run").exists("run.json")


# -- every kind of object ----------------------------------------------------------------------------------------


def extracted(run: str, suite: Suite) -> None:
    """What `extract` does with two episodes."""
    plan = little_plan(suite, episodes=2)
    writer = little_writer(locate(run), plan)
    with writer.claim():
        for number in writer.remaining():
            writer.write(episode(plan, number))
        seal(run)
        writer.opened()


def results_of(run: str) -> None:
    """What `train`, `intervene` and `diagnose` store."""
    opened = open_run(run)
    train_probes(opened, permutations=1, views=["mean"])
    train_probes(opened, permutations=1, views=["mean"], controls=("position",))
    intervene_on_little_run(opened)
    write_bundle(opened.location, DIAGNOSES, KEY, {"settings": {"format": 1}}, {"diagnosis.json": b"{}"})


def kind_of(key: str) -> str:
    """The kind of an object as a pattern of its keys: numbers and hashes may be any."""
    return "^run/" + re.sub(r"(?<![a-z.])[0-9a-f]{4,}(?![a-z])|\d+", "[0-9a-f]+", re.escape(key)) + "$"


def timeless(run: str) -> dict[str, bytes]:
    """The objects whose bytes do not say when they were made."""
    return {key: content for key, content in objects(run).items() if "times" not in key}


@pytest.fixture(scope="module")
def color(small_suite: Suite) -> Suite:
    return small_suite.select(["color"])


@pytest.fixture(scope="module")
def clean(color: Suite, tmp_path_factory: pytest.TempPathFactory) -> str:
    run = str(tmp_path_factory.mktemp("clean") / "run")
    extracted(run, color)
    return run


def attacks(server: BadServer, make: Callable[[str], None], run: str) -> list[tuple[str, str]]:
    """Every kind of object that is put there, and the call that puts it."""
    calls: list[Call] = []
    server.day.attack = calls.append  # type: ignore[assignment]  # which answers None: nothing happens
    make(run)
    server.day.attack = lambda _call: None
    return list(dict.fromkeys((kind_of(c.key.removeprefix("run/")), c.call) for c in calls if c.call in PUTS))


def errors_under(
    server: BadServer, make: Callable[[str], None], run: str, attack: Callable[[Call], str | None]
) -> list[str]:
    """Make the run, again after an error as a user would; the errors."""
    server.day.attack, errors = attack, list[str]()
    try:
        make(run)
    except StoreError as error:
        errors.append(str(error))
    finally:
        server.day.attack = lambda _call: None
    if errors:
        make(run)
    assert all("the same command continues" in error for error in errors)
    assert verify_run(run, deep=True).problems == ()
    return errors


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("answer", "times"),
    [*((answer, 1) for answer in ANSWERS), ("conflict", None), ("busy", None), ("unanswered", None)],
)
def test_no_kind_of_object_of_an_extraction_is_lost_or_believed(
    bad_server: BadServer, clean: str, color: Suite, answer: str, times: int | None
) -> None:
    make, run = partial(extracted, suite=color), f"{bad_server.url}/run"
    expected, errors = timeless(clean), list[str]()
    kinds = attacks(bad_server, make, run)
    for kind, call in kinds:
        bad_server.empty()
        bad_server.day.seen.clear()
        errors += errors_under(bad_server, make, run, first(answer, call, kind, times))
        assert bad_server.day.seen[answer], (kind, call)
        assert timeless(run) == expected, (kind, call)
    print(f"{answer}, {'once' if times else 'always'}: {len(kinds)} trials, {len(errors)} errors")
    assert len(kinds) >= 20
    assert not errors if times else len(errors) > len(kinds) / 2


@pytest.fixture
def with_results(little_runs: Path, bad_server: BadServer, tmp_path: Path) -> tuple[str, dict[str, bytes]]:
    """A run in a bucket to which results are added, and those of the same run in a folder."""
    location = locate(tmp_path / "run")
    little_run = locate(little_runs / "run")
    plain = {
        key: little_run.read(key)
        for key in little_run.keys("")
        if key.partition("/")[0] not in ("probes", "interventions")
    }
    for key, content in plain.items():
        location.write(key, content)
    results_of(str(location))
    result_objects = {key: content for key, content in timeless(str(location)).items() if key not in plain}
    return f"{bad_server.url}/run", result_objects


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("answer", ["conflict", "failed", "broken", "unanswered"])
def test_no_kind_of_object_of_a_result_is_lost_or_believed(
    bad_server: BadServer, with_results: tuple[str, dict[str, bytes]], little_runs: Path, answer: str
) -> None:
    run, expected = with_results
    target, little_run = locate(run), locate(little_runs / "run")
    for key in little_run.keys(""):
        if key.partition("/")[0] not in ("probes", "interventions"):
            target.write(key, little_run.read(key))
    kinds = attacks(bad_server, results_of, run)
    for kind, call in kinds:
        for home in ("probes", "interventions", DIAGNOSES):
            target.remove(home)
        bad_server.day.seen.clear()
        assert errors_under(bad_server, results_of, run, first(answer, call, kind)) == []
        assert {key: target.read(key) for key in expected} == expected, kind
        load_results(open_run(run))
        read_bundle(target, DIAGNOSES, KEY)
        assert bad_server.day.seen[answer], (kind, call)
    print(f"{answer}: {len(kinds)} trials")
    assert len(kinds) >= 8
