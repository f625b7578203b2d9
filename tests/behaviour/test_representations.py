"""A record counts by its values: another spelling is read, and named by `--deep`; other values are damage."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import pytest

from probe_kit.errors import ProbeKitError
from probe_kit.intervene import stored_interventions
from probe_kit.intervene.inventory import listed_interventions
from probe_kit.runs import Run, open_run, verify_run
from probe_kit.runs.commits import write_failure
from probe_kit.runs.records import HASH
from probe_kit.runs.thumbnails import read_thumbnail
from probe_kit.train import load_results, train_probes
from probe_kit.train.results.inventory import inventory
from tests.support.faults import Fault, Stored, applied
from tests.support.little_run import intervene_on_little_run
from tests.support.nightly_draws import seeds_of_tonight
from tests.support.reading import readings
from tests.support.representations import OTHERS, SPELLINGS, rewritten

pytestmark = pytest.mark.slow  # `tests/acceptance` holds what a user sees of it

Edit = Callable[[dict[str, Any]], object]
PLAN, COMMIT, TIMES = "plan/*.json", "commits/00000004.json", "times/00000004.json"
CERTIFIED = "certificates/*.json"
PROBES, INTERVENTION = "probes/*/settings.json", "interventions/*/settings.json"


def same(_content: dict[str, Any]) -> None:
    """Only the spelling is another one."""


def settings(**values: Any) -> Edit:
    return lambda content: content["settings"].update(values)


def part(name: str, value: Any) -> Edit:
    return lambda content: content.update({name: value})


def without(name: str) -> Edit:
    return lambda content: content.pop(name)


CHANGES: list[tuple[str, str, Edit]] = [
    ("run.json", "the same", same),
    ("run.json", "views exchanged", lambda card: card["streams"][0]["views"].reverse()),
    ("run.json", "fewer iterations", lambda card: card["streams"][1].update(iterations=1)),
    ("run.json", "fewer layers", lambda card: card["streams"][0].update(layers=1)),
    ("run.json", "another part", lambda card: card["streams"][0].update(part="action")),
    ("run.json", "trained weights", settings(random_weights=False)),
    ("run.json", "another model", settings(model="pi0")),
    ("run.json", "more calls", settings(captured_calls=2)),
    ("run.json", "another suite", lambda card: card["settings"]["suite"].update(identity="other@1#0")),
    ("run.json", "an older schema", part("schema_version", 2)),
    ("run.json", "the schema before", part("schema_version", 3)),
    ("run.json", "no hash of metadata", lambda card: card["objects"].popitem()),
    ("run.json", "no hashes", lambda card: card["objects"].clear()),
    ("run.json", "another hash of the settings", part("settings_sha256", "0" * 64)),
    (PLAN, "the same", same),
    (PLAN, "another run", part("run", "0" * 64)),
    (PLAN, "another place", part("record", 1)),
    (PLAN, "another plan before", part("former", "0" * 64)),
    (PLAN, "another label", lambda plan: plan["episodes"][0].update(side_correct="up")),
    (PLAN, "another category", lambda plan: plan["episodes"][1].update(category="shape")),
    (PLAN, "another order", lambda plan: plan["order"].reverse()),
    (PLAN, "an episode less", lambda plan: (plan["episodes"].pop(), plan["order"].remove(max(plan["order"])))),
    (PLAN, "an episode twice", lambda plan: plan["order"].append(0)),
    (PLAN, "another suite", lambda plan: plan["selection"]["suite"].update(identity="other@1#0")),
    (PLAN, "tokens of arrays", lambda plan: plan["tokens"].update(backbone=900)),
    (COMMIT, "the same", same),
    (COMMIT, "another plan", part("plan", "0" * 64)),
    (COMMIT, "another outcome", lambda commit: commit["outcome"].update(outcome="correct", cube_x=9.0)),
    (COMMIT, "another place", lambda commit: commit["outcome"].update(side_placed="left", cube_y=0.5)),
    (COMMIT, "another episode", part("episode", 5)),
    (COMMIT, "another run", part("run", "0" * 64)),
    (COMMIT, "other roles", lambda commit: commit["roles"][0]["backbone"].append(["state", 0, 9])),
    (COMMIT, "no roles", part("roles", [])),
    (COMMIT, "no objects", part("objects", {})),
    (COMMIT, "an object less", lambda commit: commit["objects"].popitem()),
    (COMMIT, "another's object", lambda commit: commit["objects"].update({"x/c/0": [1, "0" * 64]})),
    (COMMIT, "an object without length", lambda commit: next(iter(commit["objects"].values())).pop(0)),
    (COMMIT, "a picture elsewhere", part("pictures", {"run.json": [1, "0" * 64]})),
    (COMMIT, "a picture outside", part("pictures", {"frames/../run.json": [1, "0" * 64]})),
    (COMMIT, "other instruction ids", part("instruction_ids", [7])),
    (COMMIT, "no control steps", without("control_steps")),
    (COMMIT, "a control step behind the end", part("control_steps", [0, 99])),
    (COMMIT, "control steps in another order", part("control_steps", [1, 0])),
    (COMMIT, "fewer inferences than were captured", part("control_steps", [])),
    ("label.json", "the same", same),
    ("label.json", "another run", part("run", "0" * 64)),
    ("label.json", "no text", part("label", 7)),
    (TIMES, "the same", same),
    (TIMES, "another run", part("run", "0" * 64)),
    (TIMES, "another episode", part("episode", 5)),
    (TIMES, "less than no time", part("inference", -1.0)),
    ("sealed/*.json", "the same", same),
    ("sealed/*.json", "another stamp", part("stamp", "0" * 64)),
    ("sealed/*.json", "another run", part("run", "0" * 64)),
    ("sealed/*.json", "other episodes", part("episodes", [0, 99])),
    ("sealed/*.json", "no objects", part("objects", {})),
    ("certificate.json", "the same", same),
    ("certificate.json", "no check", without("capture_check")),
    ("certificate.json", "another device", part("device", "cuda")),
    (CERTIFIED, "the same", same),
    (CERTIFIED, "another check", lambda record: record["capture_check"].update(x="y")),
    ("provenance/*.json", "the same", same),
    ("provenance/*.json", "another device", part("device", "cuda")),
    ("provenance/*.json", "other versions", lambda provenance: provenance["versions"].update(torch="0")),
    ("failed/*.json", "the same", same),
    ("failed/*.json", "another episode", part("episode_id", "another")),
    (PROBES, "the same", same),
    (PROBES, "more label permutations", settings(permutations=2000)),
    (PROBES, "another format", settings(format=1)),
    (PROBES, "no files", without("files")),
    (PROBES, "another's file", lambda head: head["files"].update({"scores.csv": ["../x", 1, "0" * 64]})),
    ("probes/*/times.json", "the same", same),
    ("probes/*/times.json", "another run", part("run", "0" * 64)),
    (INTERVENTION, "the same", same),
    (INTERVENTION, "of other episodes", settings(stamp="0" * 64)),
    (INTERVENTION, "no files", without("files")),
    ("interventions/*/times.json", "another's", part("key", "0" * 12)),
]  # fmt: skip


@pytest.fixture(scope="module")
def run(little_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy with every kind of record, a failure among them; a test puts back what it changes."""
    run_folder = Path(shutil.copytree(little_runs / "run", tmp_path_factory.mktemp("spelt") / "run"))
    write_failure(open_run(run_folder).root, 3, "the gripper broke")
    assert verify_run(run_folder, deep=True).ok
    return run_folder


def the_record(run: Path, pattern: str) -> Path:
    return min(run.glob(pattern))


def changed(run: Path, pattern: str, edit: Edit) -> tuple[Path, dict[str, Any]]:
    path = the_record(run, pattern)
    content = json.loads(path.read_bytes())
    edit(content)
    return path, content


def test_there_are_changes_of_every_kind_of_record() -> None:
    assert len(CHANGES) > 50
    assert len({pattern for pattern, _, _ in CHANGES}) == 14


def test_every_record_may_be_spelled_otherwise(run: Path) -> None:
    """As a formatter, or a transfer that changes ends of lines, leaves it: no reading is another one.

    Only `run verify --deep`, which promises to compare every byte, names it.
    """
    before, draw = readings(run, allow_partial=True), Random(0)
    for pattern in sorted({pattern for pattern, _, _ in CHANGES}):
        path, content = changed(run, pattern, same)
        way = draw.choice(sorted(SPELLINGS))
        with applied({path: SPELLINGS[way](content)}):
            assert verify_run(run).problems == (), (path, way)
            problems = verify_run(run, deep=True).problems
            assert any("same values in other bytes" in problem for problem in problems), (path, way, problems)
            assert readings(run, allow_partial=True) == before, (path, way)


@pytest.mark.parametrize("way", OTHERS)
@pytest.mark.parametrize("pattern", sorted({pattern for pattern, _, _ in CHANGES}))
def test_bytes_that_are_no_record_are_named(run: Path, pattern: str, way: str) -> None:
    path, content = changed(run, pattern, same)
    with applied({path: OTHERS[way](content)}):
        problems = verify_run(run).problems
    name = path.parent.name if path.parent != run else path.name
    assert any(name in problem for problem in problems), problems or "unseen"


@pytest.mark.parametrize(
    "change", [change for change in CHANGES if change[1] != "the same"], ids=lambda change: " ".join(change[:2])
)
def test_a_changed_value_under_the_former_hash_is_named(run: Path, change: tuple[str, str, Edit]) -> None:
    path, content = changed(run, *change[::2])
    with applied({path: json.dumps(content).encode()}):
        problems = verify_run(run).problems
    name = path.parent.name if path.parent != run else path.name
    assert any(name in problem for problem in problems), problems or "unseen"


@pytest.mark.parametrize(
    "change", [change for change in CHANGES if change[1] != "the same"], ids=lambda change: " ".join(change[:2])
)
def test_a_changed_record_with_its_own_hash_computed_anew_is_named(
    run: Path, change: tuple[str, str, Edit]
) -> None:
    """What other records say of it, or what it can say at all, contradicts it."""
    path, content = changed(run, *change[::2])
    with applied({path: rewritten(content)}):
        problems = verify_run(run).problems
        try:
            readings(run)
        except ProbeKitError as error:
            problems += (str(error),)
    assert problems


# -- records that say something else than they can -------------------------------------------------------

RECORDS = sorted({pattern for pattern, _, _ in CHANGES})
WRONG = (None, [], {}, "x", -1, 1.5, True, [[]], {"x": {}})


def places(content: Any, depth: int = 4) -> Iterator[tuple[Any, Any]]:
    """What can be changed: every holder with every name in it, but of long lists only the first two."""
    pairs = list(content.items() if isinstance(content, dict) else enumerate(content[:2]))
    for name, value in pairs:
        if name != HASH:
            yield content, name
            if depth and isinstance(value, dict | list):
                yield from places(value, depth - 1)


def malformed(raw: bytes, wrong: tuple[Any, ...]) -> Iterator[tuple[str, bytes]]:
    """The record with one part taken out, or in the place of it something of another kind, and a right hash."""
    for at in range(len(list(places(json.loads(raw))))):
        for value in (*wrong, ...):
            content = json.loads(raw)
            holder, name = list(places(content))[at]
            if value is ...:
                del holder[name]
            else:
                holder[name] = value
            yield f"{name} {'taken out' if value is ... else f'is {value!r}'}", rewritten(content)


def look_at_everything(run: Path) -> None:
    """All records, and everything printed of them; not the arrays."""
    opened = open_run(run, allow_partial=True)
    opened.certificate, repr(opened), opened._repr_html_()
    inventory(opened)
    listed_interventions(opened)
    for intervention in stored_interventions(opened):
        _ = intervention.certificate
    load_results(opened)
    read_thumbnail(opened.location, 4)


def assert_no_traceback(run: Path, path: Path, cases: list[tuple[str, bytes]]) -> None:
    wrong = []
    for words, raw in cases:
        with applied({path: raw}):
            try:
                verify_run(run)
                look_at_everything(run)
            except ProbeKitError:
                continue
            except Exception as error:  # noqa: BLE001 - whatever is no error of ours is a traceback for a user
                wrong.append(f"{words}: {type(error).__name__}: {error}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("pattern", RECORDS)
def test_a_malformed_record_with_a_right_hash_is_damage_and_no_traceback(run: Path, pattern: str) -> None:
    path = the_record(run, pattern)
    cases = list(malformed(path.read_bytes(), WRONG))
    assert_no_traceback(run, path, Random(pattern).sample(cases, 6))


@pytest.mark.parametrize("pattern", RECORDS)
def test_no_malformed_record_with_a_right_hash_ends_in_a_traceback(run: Path, pattern: str) -> None:
    path = the_record(run, pattern)
    assert_no_traceback(run, path, list(malformed(path.read_bytes(), WRONG)))


# -- random changes of a real run ------------------------------------------------------------------------


def changed_bytes(stored: Stored, draw: Random) -> Fault | None:
    """One byte replaced, put in or taken out, anywhere in a file of any kind."""
    path = stored.draw(draw)
    content = path.read_bytes()
    offset, byte = draw.randrange(len(content)), bytes([draw.randrange(256)])
    how = draw.choice(("replaced", "put in", "taken out"))
    tail = content[offset + (how != "put in") :]
    after = content[:offset] + (byte if how != "taken out" else b"") + tail
    return None if after == content else Fault(f"byte {offset} of {path} {how}", {path: after})


@pytest.fixture(scope="module")
def real(trainable_run: Run, tmp_path_factory: pytest.TempPathFactory) -> Stored:
    """A copy of a run of pi0-tiny with all tokens, with probes and an intervention."""
    run_folder = Path(shutil.copytree(trainable_run.path, tmp_path_factory.mktemp("real") / "run"))
    train_probes(open_run(run_folder), ["color"], permutations=1)
    intervene_on_little_run(open_run(run_folder))
    return Stored.of(run_folder, run_folder)


def assert_none_is_silent(stored: Stored, seeds: range) -> None:
    """Each is found by `run verify --deep`, or nothing that can be read is another number."""
    wrong = []
    for seed in seeds:
        if fault := changed_bytes(stored, Random(seed)):
            with applied(fault.change):
                try:
                    if verify_run(stored.run, deep=True).ok and readings(stored.run) != stored.before:
                        wrong.append(f"seed {seed}: {fault.words}: SILENT")
                except ProbeKitError:
                    continue
                except Exception as error:  # noqa: BLE001 - whatever is no error of ours is a traceback for a user
                    wrong.append(f"seed {seed}: {fault.words}: {type(error).__name__}: {error}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("seeds", seeds_of_tonight(400), ids=str)
def test_no_changed_byte_of_a_real_run_is_silent(real: Stored, seeds: range) -> None:
    assert_none_is_silent(real, seeds)
