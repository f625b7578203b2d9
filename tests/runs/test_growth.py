"""A run grows: by more items, categories and wordings; what it has stays byte for byte, and nothing ever goes."""

import json
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from probe_kit.errors import NoProbesError, RunDamagedError, RunIncompleteError, SettingsMismatchError
from probe_kit.extract import Extraction, ExtractSettings
from probe_kit.extract.prompts import QUERIES, phrases
from probe_kit.runs import Run, open_run, seal, verify_run
from probe_kit.runs.folder import Folder
from probe_kit.runs.plan import Plan, plan_key
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.runs.writer import RunWriter, growth_words
from probe_kit.suite import Suite
from probe_kit.suite.items import Wording
from probe_kit.train import load_results, train_probes
from probe_kit.train.results.inventory import inventory
from tests.support.changed_suites import without_twins
from tests.support.little_run import STREAMS, certify, episode, little_settings, still
from tests.support.plans import make_plan
from tests.support.rehashing import write_record

pytestmark = pytest.mark.slow  # `tests/acceptance` holds what a user sees of it

Selection = tuple[Sequence[str], int, Sequence[Wording] | None]
COLOR: list[Selection] = [(["color"], items, None) for items in (2, 4, 6)]
CHAINS: dict[str, list[Selection]] = {
    "more items": COLOR,
    "more categories before the first": [(["shape"], 2, None), (["color", "shape"], 2, None)],
    "both": [(["color"], 2, None), (["color", "shape"], 2, None), (["color", "shape"], 6, None)],
    "more wordings": [(["color"], 2, ["knowledge"]), (["color"], 4, ["side", "knowledge", "neutral"])],
    "nothing": [(["color"], 2, None), (["color"], 2, None)],
}


def plan_of(suite: Suite, selection: Selection) -> Plan:
    categories, items, wordings = selection
    return make_plan(suite.select(categories, items), list(STREAMS), 0, 1, False, wordings)


def writer_of(where: Path, plan: Plan) -> RunWriter:
    writer = RunWriter(locate(where), plan, {**little_settings(), "tokens": "pooled"})
    certify(writer)
    return writer


def play(writer: RunWriter, last: Plan, numbers: Sequence[int] | None = None) -> None:
    """What an episode gives follows from its place in `last`, whatever its number is."""
    places = {episode_plan.content.episode_id: index for index, episode_plan in enumerate(last.episodes)}
    for number in writer.remaining() if numbers is None else numbers:
        planned = writer.plan.episode(number)
        position = places[planned.content.episode_id]
        record = episode(last, position)
        pictures = {thumbnail_key(number): as_thumbnail(still(0, position))}
        arrays = {"pooled": record.arrays["pooled"]}
        writer.write(replace(record, planned=planned, pictures=pictures, arrays=arrays))


def extracted(where: Path, suite: Suite, selections: Sequence[Selection]) -> Run:
    """A run that is played, sealed and grown selection by selection; growing changes no byte of what is there."""
    last = plan_of(suite, selections[-1])
    for selection in selections:
        before = stored_files(where)
        play(writer_of(where, plan_of(suite, selection)), last)
        seal(where)
        assert before.items() <= stored_files(where).items()
    return open_run(where)


def stored_files(run: Path) -> dict[str, bytes]:
    """All that is not derived of other files; the arrays' metadata says for other tools how long the plan is."""
    derived = ("columns.zarr/", "sealed/")
    files = files_of(run).items()
    return {name: raw for name, raw in files if not (name.startswith(derived) or name.endswith("/zarr.json"))}


def files_of(run: Path) -> dict[str, bytes]:
    return {path.relative_to(run).as_posix(): path.read_bytes() for path in run.rglob("*") if path.is_file()}


def contents(run: Run) -> dict[str, Any]:
    """By episode, every byte that belongs to it, under names that hold no number."""
    by_episode = {}
    for number, name in zip(run.episodes["episode"], run.episodes["episode_id"], strict=True):
        commit = json.loads((run.path / f"commits/{number:08d}.json").read_bytes())
        objects = {key.replace(f"/c/{number}/", "/c/#/"): (run.path / "data.zarr" / key).read_bytes()
                   for key in commit["objects"]}  # fmt: skip
        facts = {key: commit[key] for key in ("run", "episode_id", "outcome", "roles", "instruction_ids",
                                             "control_steps", "provenance")}  # fmt: skip
        by_episode[name] = [facts, objects, (run.path / thumbnail_key(number)).read_bytes()]
    return by_episode


# -- what grew is what would have been extracted at once ---------------------------------------------------


@pytest.mark.parametrize("chain", CHAINS)
def test_a_grown_run_equals_one_extracted_at_once_episode_by_episode(
    chain: str, small_suite: Suite, tmp_path: Path
) -> None:
    grown = extracted(tmp_path / "grown", small_suite, CHAINS[chain])
    at_once = extracted(tmp_path / "at_once", small_suite, CHAINS[chain][-1:])
    assert (grown.path / "run.json").read_bytes() == (at_once.path / "run.json").read_bytes()
    assert contents(grown) == contents(at_once)
    times = ["episode", "seconds_inference", "seconds_simulation"]
    assert grown.episodes.drop(columns=times).equals(at_once.episodes.drop(columns=times))
    assert (grown.settings, grown.suite, grown.suite_parent) == (
        at_once.settings,
        at_once.suite,
        at_once.suite_parent,
    )
    assert grown.items.equals(at_once.items)
    assert grown.wordings == at_once.wordings
    for site in [*grown.sites("backbone"), *grown.sites("expert")]:
        np.testing.assert_array_equal(grown.column(site), at_once.column(site))
    np.testing.assert_array_equal(
        [trajectory.frames for trajectory in grown.trajectories],
        [trajectory.frames for trajectory in at_once.trajectories],
    )
    assert grown.sealed
    verification = verify_run(grown.path, deep=True)
    assert (verification.ok, verification.finished, verification.strays) == (True, True, ())


def test_plain_zarr_reads_the_episodes_of_a_grown_run(small_suite: Suite, tmp_path: Path) -> None:
    run = extracted(tmp_path / "run", small_suite, COLOR)
    arrays = [
        zarr.open_array(run.path / "data.zarr" / name, mode="r") for name in ("backbone/pooled", "trajectory")
    ]
    assert [array.shape[0] for array in arrays] == [array.attrs["episodes"] for array in arrays] == [12, 12]
    assert not np.isnan(arrays[0][:]).any()
    identity = run.root.identity
    writer_of(run.path, plan_of(small_suite, (["color"], 8, None)))
    longer = zarr.open_array(run.path / "data.zarr/backbone/pooled", mode="r")
    assert (longer.shape[0], longer.attrs["episodes"], open_run(run.path, allow_partial=True).root.identity) == (
        16, 16, identity,
    )  # fmt: skip
    assert np.isnan(longer[12:]).all()


@pytest.mark.parametrize("query", QUERIES)
def test_the_plan_of_more_items_holds_the_plan_of_fewer(query: Any, small_suite: Suite) -> None:
    for category in ("color", "shape"):
        plans, phrases_by_item = [], []
        for items in (2, 4, 12):
            suite = small_suite.select([category], items)
            item_phrases = phrases(suite, query)
            rows = make_plan(suite, [], 3, 1, False, ("knowledge", "side")).columns
            plans.append({row["episode_id"]: {**row, "episode": None} for row in rows})
            phrases_by_item.append({item: phrase.text for item, phrase in item_phrases.items()})
        for fewer, more in ((0, 1), (1, 2)):
            assert plans[fewer].items() <= plans[more].items()
            assert phrases_by_item[fewer].items() <= phrases_by_item[more].items()


def test_a_plan_that_was_made_without_its_model_is_compared_with_the_stored_one(
    small_suite: Suite, tmp_path: Path
) -> None:
    """As by `--dry-run`, which knows no weights."""
    run = extracted(tmp_path / "run", small_suite, COLOR[:1])
    plan = replace(plan_of(small_suite, COLOR[1]), bytes=800)
    settings: Any = ExtractSettings("pi0-tiny", suite=small_suite.folder)
    declared = Extraction(settings, settings.source.open(), plan, {"weights_sha256": None}, None, declared="so")
    growth = declared.further_plan(run.location)
    assert {planned_episode.content.episode_id for planned_episode in growth.episodes}.isdisjoint(
        run.episodes["episode_id"]
    )
    assert (len(growth.episodes), growth.bytes) == (4, 400)


# -- never fewer ------------------------------------------------------------------------------------------


def test_fewer_items_play_nothing_and_the_run_stays_as_it_is(small_suite: Suite, tmp_path: Path) -> None:
    run = extracted(tmp_path / "run", small_suite, COLOR[2:])
    before = files_of(run.path)
    fewer = plan_of(small_suite, COLOR[0])
    words = growth_words(run.location, fewer)
    assert words == "no: the run has 12 episodes, these 4 among them, and never shrinks"
    assert writer_of(run.path, fewer).remaining() == []
    assert files_of(run.path) == before


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (
            lambda suite: plan_of(suite, (["shape"], 4, None)),
            r"items of color 4; .*asks for items of shape 4.*never",
        ),
        (lambda suite: plan_of(suite, (["color", "shape"], 2, None)), r"4 of its episodes are not asked for"),
        (
            lambda suite: plan_of(suite, (["color"], 6, ["knowledge"])),
            r"wording is stored as None, here 'knowledge'",
        ),
        (
            lambda suite: make_plan(suite.select(["color"], 6), list(STREAMS), 1, 1, False),
            r"its policy_seed is stored",
        ),
        (lambda suite: plan_of(without_twins(suite), COLOR[2]), r"its item_content_sha256 is stored"),
    ],
    ids=["another category", "fewer of one, more of another", "wordings", "another seed", "twins"],
)
def test_a_plan_that_does_not_hold_the_stored_one_is_refused_by_name(
    change: Callable[[Suite], Plan], why: str, small_suite: Suite, tmp_path: Path
) -> None:
    run = extracted(tmp_path / "run", small_suite, COLOR[:2])
    before = files_of(run.path)
    with pytest.raises(SettingsMismatchError, match=why):
        writer_of(run.path, change(small_suite))
    assert files_of(run.path) == before


def test_arrays_of_all_tokens_take_no_longer_instructions_and_pooled_ones_do(
    small_suite: Suite, tmp_path: Path
) -> None:
    longer = [replace(stream, tokens=stream.tokens + 1) for stream in STREAMS]
    suite = small_suite.select(["color"], 4)
    for tokens in ("all", "pooled"):
        settings, where = {**little_settings(), "tokens": tokens}, locate(tmp_path / tokens)
        RunWriter(
            where, make_plan(small_suite.select(["color"], 2), list(STREAMS), 0, 1, tokens == "all"), settings
        )
        plan = make_plan(suite, longer, 0, 1, tokens == "all")
        if tokens == "all":
            with pytest.raises(SettingsMismatchError, match=r"stores 130 tokens of backbone .* needs 131"):
                RunWriter(where, plan, settings)
        else:
            assert [stream.tokens for stream in RunWriter(where, plan, settings).streams] == [131, 4]
            fewer = make_plan(small_suite.select(["color"], 2), list(STREAMS), 0, 1, False)
            assert [stream.tokens for stream in RunWriter(where, fewer, settings).streams] == [131, 4]


# -- kills, other processes, readers -----------------------------------------------------------------------


class KilledError(Exception):
    """Stands for a process that ends here."""


@pytest.mark.parametrize("point", ["before the record", "after the record"])
def test_a_kill_while_a_run_grows_loses_nothing(
    point: str, small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    undisturbed = files_of(extracted(tmp_path / "undisturbed", small_suite, COLOR[:2]).path)
    run = extracted(tmp_path / "run", small_suite, COLOR[:1])
    before = contents(run)
    create = Folder.create

    def kill_at_creation(location: Folder, key: str, record: bytes) -> bool:
        if point == "after the record":
            create(location, key, record)
        raise KilledError

    with monkeypatch.context() as patched, suppress(KilledError):
        patched.setattr(Folder, "create", kill_at_creation)
        RunWriter(run.location, plan_of(small_suite, COLOR[1]), {**little_settings(), "tokens": "pooled"})
    killed = open_run(run.path, allow_partial=True)
    assert contents(killed) == before
    assert verify_run(run.path, deep=True).ok
    assert killed.planned == (4 if point == "before the record" else 8)
    assert killed.column(killed.sites("backbone")[0]).shape[0] == 4
    again = extracted(run.path, small_suite, COLOR[1:2])
    assert again.planned == 8
    assert files_of(run.path) == undisturbed


def test_a_run_that_was_killed_before_its_first_plan_says_so_and_begins(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    create = Folder.create

    def killed(location: Folder, key: str, content: bytes) -> bool:
        if key == plan_key(0):
            raise KilledError
        return create(location, key, content)

    with monkeypatch.context() as patched, suppress(KilledError):
        patched.setattr(Folder, "create", killed)
        writer_of(tmp_path / "run", plan_of(small_suite, COLOR[0]))
    with pytest.raises(RunIncompleteError, match="has no plan yet"):
        open_run(tmp_path / "run", allow_partial=True)
    verification = verify_run(tmp_path / "run")
    assert (verification.ok, verification.finished) == (True, False)
    assert files_of(extracted(tmp_path / "run", small_suite, COLOR[:1]).path) == files_of(
        extracted(tmp_path / "other", small_suite, COLOR[:1]).path
    )


def test_processes_that_begin_with_nested_plans_at_once_leave_one_run(small_suite: Suite, tmp_path: Path) -> None:
    plans = [plan_of(small_suite, selection) for selection in [*COLOR, (["color", "shape"], 6, None)]]
    with ThreadPoolExecutor(4) as processes:
        writers = list(processes.map(lambda plan: writer_of(tmp_path / "run", plan), plans))
        list(processes.map(lambda writer: play(writer, plans[-1]), writers))
    seal(tmp_path / "run")
    run = open_run(tmp_path / "run")
    assert (run.planned, len(run.episodes)) == (24, 24)
    assert verify_run(run.path, deep=True).ok


def test_who_works_with_the_smaller_plan_is_not_disturbed_by_a_growth(small_suite: Suite, tmp_path: Path) -> None:
    small, large = (plan_of(small_suite, selection) for selection in COLOR[:2])
    first = writer_of(tmp_path / "run", small)
    second = writer_of(tmp_path / "run", large)
    play(second, large, second.remaining()[-2:])
    assert first.remaining() == [0, 1, 2, 3]
    play(first, large)
    assert len(open_run(tmp_path / "run", allow_partial=True).episodes) == 6
    play(second, large)
    seal(tmp_path / "run")
    at_once = extracted(tmp_path / "at_once", small_suite, COLOR[1:2])
    assert contents(open_run(tmp_path / "run")) == contents(at_once)


def test_who_reads_while_a_run_grows_reads_what_was_opened(small_suite: Suite, tmp_path: Path) -> None:
    run = extracted(tmp_path / "run", small_suite, COLOR[:1])
    site = run.sites("backbone")[0]
    expected = [run.rows("backbone")[row] for row in range(4)]
    extracted(run.path, small_suite, COLOR[1:2])
    np.testing.assert_array_equal([run.rows("backbone")[row] for row in range(4)], expected)
    assert len(run.trajectories[3].frames) == 3
    assert open_run(run.path).column(site).shape[0] == 8


# -- what was made of the former episodes ------------------------------------------------------------------


def test_former_probes_and_seals_are_named_and_not_read(small_suite: Suite, tmp_path: Path) -> None:
    run = extracted(tmp_path / "run", small_suite, [(["color"], 10, None)])
    key = train_probes(run, permutations=1).key
    plan = plan_of(small_suite, (["color"], 12, None))
    assert (
        growth_words(run.location, plan)
        == f"from 20 to 24 episodes; stored ones stay as they are; of the former episodes only: probes {key}"
    )
    play(writer_of(run.path, plan), plan)
    grown = open_run(run.path)
    assert not grown.sealed
    assert [(entry.key, entry.state) for entry in inventory(grown).probes] == [(key, "other episodes")]
    with pytest.raises(NoProbesError, match="of 1 stored, none: other episodes"):
        load_results(grown)
    assert seal(run.path)
    assert len(list((run.path / "sealed").iterdir())) == 1
    again = train_probes(open_run(run.path), permutations=1)
    assert again.key != key
    assert {entry.state for entry in inventory(open_run(run.path)).probes} == {"used", "other episodes"}


# -- a growth record is a record ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def untouched(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return extracted(tmp_path_factory.mktemp("grown") / "run", small_suite, COLOR[:2]).path


@pytest.fixture
def grown(untouched: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(untouched, tmp_path / "run"))


@pytest.mark.parametrize(
    "change",
    [
        lambda plan: plan["episodes"][0].update(side_correct="up"),
        lambda plan: plan["order"].reverse(),
        lambda plan: plan["order"].append(3),
        lambda plan: plan["order"].append("x"),
        lambda plan: plan["episodes"].pop(),
        lambda plan: plan["episodes"][0].update(episode=0),
        lambda plan: plan.update(record=0),
        lambda plan: plan.update(run="0" * 64),
        lambda plan: plan["selection"].update(items=2),
        lambda plan: plan["selection"]["suite"].update(identity="other@1#0"),
        lambda plan: plan["tokens"].clear(),
    ],
    ids=["a label", "order", "a place twice", "no number", "an episode less", "a number twice", "another place",
         "another run", "items", "suite", "tokens"],
)  # fmt: skip
@pytest.mark.parametrize("hashed", [True, False], ids=["with a right hash", "as it is"])
@pytest.mark.parametrize("record", [0, 1])
def test_a_changed_growth_record_is_damage(
    record: int, hashed: bool, change: Callable[[dict[str, Any]], object], grown: Path
) -> None:
    path = grown / plan_key(record)
    before, content = path.read_bytes(), json.loads(path.read_bytes())
    change(content)
    if hashed:
        write_record(path, content)
    else:
        path.write_text(json.dumps(content, sort_keys=True, indent=1), encoding="utf-8")
    if path.read_bytes() == before:
        return  # the first record is at place 0, after nothing
    with pytest.raises(RunDamagedError, match=r"plan/|commits/"):
        open_run(grown, allow_partial=True)
    assert not verify_run(grown).ok


@pytest.mark.parametrize(
    ("lost", "why"),
    [
        (0, r"plan/00000000\.json is missing, though plan/00000001"),
        (1, "commits an episode that the run does not plan"),
    ],
)
def test_a_lost_growth_record_is_damage(lost: int, why: str, grown: Path, small_suite: Suite) -> None:
    content = (grown / plan_key(lost)).read_bytes()
    (grown / plan_key(lost)).unlink()
    with pytest.raises(RunDamagedError, match=why):
        open_run(grown, allow_partial=True)
    assert not verify_run(grown).ok
    if lost:  # the command that let it grow writes the same record again
        writer_of(grown, plan_of(small_suite, COLOR[1]))
        assert (grown / plan_key(lost)).read_bytes() == content
        assert open_run(grown).planned == 8
