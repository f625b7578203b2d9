"""An intervention on a real run: what is replayed is the run's, and what is stored is whole and protected."""

import json
import shutil
from dataclasses import asdict, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from probe_kit.env import SceneSpec
from probe_kit.errors import (
    CaptureChangedActionError,
    NoInterventionsError,
    RunDamagedError,
    SceneError,
    SettingsMismatchError,
    SuiteError,
    UnknownCategoryError,
    UsageError,
)
from probe_kit.extract import ExtractSettings
from probe_kit.extract.config_files import origin_of_process
from probe_kit.extract.sources.scene_source import ScenePlayer
from probe_kit.intervene import (
    ImageSwap,
    InstructionSwap,
    InterventionResult,
    ReplayFiles,
    load_effects,
    run_intervention,
    stored_interventions,
)
from probe_kit.intervene.open_session import load_policy_of, open_session
from probe_kit.intervene.outcomes import arrays_of
from probe_kit.intervene.runner import too_few_groups
from probe_kit.intervene.sessions import ReplaySession
from probe_kit.intervene.stored import EPISODES
from probe_kit.retention import retention_table
from probe_kit.runs import Run, open_run, verify_run
from probe_kit.runs.results import Pieces, RepeatedWorkWarning
from tests.intervene.answers import with_parts

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

pytestmark = pytest.mark.slow  # `tests/acceptance` holds what a user sees of it

FILES = ("episodes.npz", "effects.csv", "certificate.json")


@pytest.fixture(scope="module")
def effects(copy: Run, source: ReplayFiles, twin: "Policy") -> InterventionResult:
    return run_intervention(copy, ImageSwap(items=2), source, load=lambda *_: twin)


@pytest.fixture
def mine(copy: Run, effects: InterventionResult, tmp_path: Path) -> Run:
    """One that a test may damage."""
    assert effects
    return open_run(shutil.copytree(copy.path, tmp_path / "run"))


# -- replaying -----------------------------------------------------------------------------------------------


def test_plain_inferences_are_the_runs_bit_for_bit(effects: InterventionResult) -> None:
    check = effects.certificate["replay"]
    assert check == {"episodes": 8, "compared": 8, "equal": 8, "largest_difference": 0.0}


def test_too_few_groups_are_said_to_show_nothing(effects: InterventionResult) -> None:
    assert len(effects.notes) == 2
    assert "with 1 group of items no p can be below 0.5, so that nothing is beyond chance" in effects.notes[0]
    assert all(min(row.follow_p, row.reversal_p) >= 0.5 for row in effects.effects)
    enough = replace(effects.outcomes, groups=np.array([f"g{number}" for number in range(8)]))
    many = replace(enough, categories=np.full(8, "color"))
    assert with_parts(effects, many).notes == ()


def test_the_other_layout_is_the_same_scene_with_its_pictures_exchanged(copy: Run, session: ReplaySession) -> None:
    """State and noise stay; and what one layout sees exchanged is what the other one sees, set up by itself."""
    item = str(copy.episodes["item_id"][0])
    original, swapped = session.pairs(item)
    row, seed = session.planned(swapped), session.planned(original).columns["scene_seed"]
    planned = replace(row, columns={**row.columns, "scene_seed": seed})
    alone = ScenePlayer(session.scene)
    looked, facts = alone.look(planned)
    alone.close()
    np.testing.assert_array_equal(original.source.image, looked.image)
    assert facts["first_frame_sha256"] == copy.episodes["first_frame_sha256"][swapped.row]
    np.testing.assert_array_equal(original.source.image, swapped.clean.image)
    np.testing.assert_array_equal(swapped.source.image, original.clean.image)
    assert (original.clean.image != original.source.image).any()
    np.testing.assert_array_equal(original.clean.state, original.source.state)
    assert original.clean.instruction == original.source.instruction
    assert original.seed != swapped.seed


def test_left_of_the_middle_is_positive(session: ReplaySession, copy: Run) -> None:
    (replay_input, _) = session.pairs(str(copy.episodes["item_id"][0]))
    still = np.zeros((4, 7), np.float32)
    moved_left = still.copy()
    moved_left[:, 1] = 0.05
    at_rest = session.lateral_displacement(still, replay_input.clean)
    assert at_rest == pytest.approx(replay_input.clean.state[1] - 0.028, abs=1e-6)
    assert session.lateral_displacement(moved_left, replay_input.clean) == pytest.approx(at_rest + 0.2, abs=1e-6)


def test_another_policy_is_noticed_by_what_it_does(session: ReplaySession, copy: Run) -> None:
    (replay_input, _) = session.pairs(str(copy.episodes["item_id"][0]))
    chunk = session.act(replay_input.clean, replay_input.seed)
    assert session.replay_error(replay_input, chunk) == 0.0
    with pytest.raises(CaptureChangedActionError, match="differs from the stored one"):
        session.replay_error(replay_input, chunk + 0.1)
    assert np.isnan(session.replay_error(replace(replay_input, stored=None), chunk))


# -- storing -------------------------------------------------------------------------------------------------


def test_a_stored_intervention_is_loaded_and_not_played_again(copy: Run, effects: InterventionResult) -> None:
    def load(*_: object) -> "Policy":
        raise AssertionError("it is stored")

    again = run_intervention(copy, ImageSwap(items=2), ReplayFiles(Path("nowhere")), load=load)
    assert again.key == effects.key
    assert again.to_csv() == effects.to_csv() == load_effects(copy).to_csv()
    assert json.loads(effects.to_json())["settings"]["items"] == 2


def test_a_stored_intervention_is_found_by_its_key_and_no_other_one_is_read(
    mine: Run, effects: InterventionResult
) -> None:
    other = mine.path / "interventions" / "0123456789ab"
    shutil.copytree(mine.path / "interventions" / effects.key, other)
    again = run_intervention(mine, ImageSwap(items=2), ReplayFiles(Path("nowhere")))
    assert again.key == effects.key
    with pytest.raises(RunDamagedError, match="0123456789ab"):
        load_effects(mine)  # the newest of all, which are read
    with pytest.raises(RunDamagedError, match="0123456789ab"):
        again.to_csv()  # its verdicts are of all interventions


def test_an_intervened_run_is_whole(copy: Run, effects: InterventionResult) -> None:
    verification = verify_run(copy.path, deep=True)
    assert (verification.problems, verification.strays) == ((), ())
    assert [intervention.key for intervention in stored_interventions(copy)] == [effects.key]


def test_killed_and_resumed_gives_the_same_bytes(
    copy: Run, effects: InterventionResult, mine: Run, source: ReplayFiles, twin: "Policy"
) -> None:
    folder = mine.path / "interventions" / effects.key
    shutil.rmtree(folder)
    calls = []

    def stop(finished: int, _total: int, what: str) -> None:
        calls.append(what)
        if finished == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_intervention(mine, ImageSwap(items=2), source, load=lambda *_: twin, progress=stop)
    assert verify_run(mine.path, deep=True).ok
    assert stored_interventions(mine) == []
    partial = mine.path / "interventions" / f".{effects.key}.partial"
    before = {path.name: path.stat().st_mtime_ns for path in partial.iterdir()}
    assert len(before) == 3
    run_intervention(mine, ImageSwap(items=2), source, load=lambda *_: twin)
    assert not partial.exists()
    for name in FILES:
        assert (folder / name).read_bytes() == (copy.path / "interventions" / effects.key / name).read_bytes()


@pytest.mark.parametrize("damage", ["cut", "emptied", "another piece"])
def test_a_damaged_piece_is_said_and_computed_again(
    damage: str, copy: Run, mine: Run, effects: InterventionResult, source: ReplayFiles, twin: "Policy"
) -> None:
    """As a power cut leaves one: pieces are not flushed."""
    folder = mine.path / "interventions" / effects.key
    shutil.rmtree(folder)

    def stop(finished: int, *_: object) -> None:
        if finished == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_intervention(mine, ImageSwap(items=2), source, load=lambda *_: twin, progress=stop)
    first, second = sorted((mine.path / "interventions" / f".{effects.key}.partial").iterdir())
    content = second.read_bytes()
    remains = {"cut": content[: len(content) // 2], "emptied": b"", "another piece": first.read_bytes()}
    second.write_bytes(remains[damage])
    with pytest.warns(RepeatedWorkWarning, match=f"{second.name} was changed"):
        run_intervention(mine, ImageSwap(items=2), source, load=lambda *_: twin)
    for name in FILES:
        assert (folder / name).read_bytes() == (copy.path / "interventions" / effects.key / name).read_bytes()


def test_a_piece_of_another_version_is_refused_with_what_to_do(
    mine: Run, effects: InterventionResult, source: ReplayFiles, twin: "Policy"
) -> None:
    folder = mine.path / "interventions" / effects.key
    shutil.rmtree(folder)
    pieces = Pieces.of(mine.location, "interventions", effects.key, mine.stamp, "")
    arrays = arrays_of(effects.outcomes, ("seed_text",))
    pieces.keep("000000", {"lateral" if name == "displacement" else name: arrays[name] for name in arrays})
    with pytest.raises(RunDamagedError) as refusal:
        run_intervention(mine, ImageSwap(items=2), source, load=lambda *_: twin)
    assert str(refusal.value).endswith(
        f"000000.npz lacks displacement and holds lateral: another version of probe_kit began this. Remove "
        f"interventions/.{effects.key}.partial; the same `probe-kit intervene` then plays it again"
    )


def test_a_stored_intervention_of_another_version_is_refused_with_what_to_do(
    mine: Run, effects: InterventionResult
) -> None:
    (stored,) = stored_interventions(mine)
    arrays = arrays_of(effects.outcomes, ("seed_text",))
    del arrays["displacement"]
    content = BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    with pytest.raises(RunDamagedError, match=r"episodes\.npz lacks displacement: another version"):
        _ = replace(stored, read={EPISODES: content.getvalue()}.__getitem__).outcomes


@pytest.mark.parametrize("name", [*FILES, "settings.json"])
def test_a_changed_file_is_found(mine: Run, effects: InterventionResult, name: str) -> None:
    path = mine.path / "interventions" / effects.key / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert any(name in problem for problem in verify_run(mine.path, deep=True).problems)


@pytest.mark.parametrize("name", ["episodes.npz", "settings.json"])
def test_no_table_is_made_of_a_changed_intervention(mine: Run, effects: InterventionResult, name: str) -> None:
    path = mine.path / "interventions" / effects.key / name
    path.write_bytes(path.read_bytes()[:-3] + b"}\n ")
    with pytest.raises(RunDamagedError, match=name):
        retention_table([open_run(mine.path)])


def test_a_stored_result_of_other_episodes_is_not_used(mine: Run) -> None:
    (mine.path / "commits/00000003.json").unlink()
    shutil.rmtree(mine.path / "sealed")  # else it is a run that lost an episode
    fewer = open_run(mine.path, allow_partial=True)
    assert stored_interventions(fewer) == []
    with pytest.raises(NoInterventionsError, match="probe-kit intervene"):
        load_effects(fewer)
    assert all(row.image_swap.follow_rate is None for row in retention_table([fewer]).rows)


def test_categories_with_too_few_groups_for_not_used_are_named_beforehand(copy: Run) -> None:
    categories = dict.fromkeys(copy.episodes["category"])
    assert too_few_groups(copy, ImageSwap(items=2)).keys() == categories.keys()
    assert max(too_few_groups(copy, ImageSwap(items=2)).values()) <= 2
    assert too_few_groups(copy, InstructionSwap(items=2)) == {}


# -- what retention makes of it ------------------------------------------------------------------------------


def test_tables_show_it_beside_the_success_rate(copy: Run, effects: InterventionResult) -> None:
    table = retention_table([copy])
    assert {row.category: row.image_swap.follow_rate for row in table.rows} == {
        row.category: row.follow_rate for row in effects.effects
    }
    uses = [row.image_swap.use for row in table.rows]
    assert {use.behaviour for use in uses if use is not None} <= {"not used", "undecided"}
    for text in (table.to_markdown(), table.to_latex("all")):
        assert "ollow / reversal" in text
    stored = json.loads(table.to_json())[0]["image_swap"]["use"]
    assert uses[0] is not None
    assert stored == asdict(uses[0])
    assert set(stored) >= {"behaviour", "reversed", "where", "tie", "reason"}


def test_tables_of_other_runs_have_no_such_column(recorded_run: Run) -> None:
    assert "ollows" not in retention_table([recorded_run]).to_markdown()


# -- refusing ------------------------------------------------------------------------------------------------


def test_another_policy_another_suite_another_category_are_refused(
    copy: Run, source: ReplayFiles, twin: "Policy", pi0_tiny: "Policy", tmp_path: Path
) -> None:
    from probe_kit.suite import build_suite

    with pytest.raises(SettingsMismatchError, match="weights"):
        run_intervention(copy, ImageSwap(items=1), source, load=lambda *_: pi0_tiny)
    other = build_suite(tmp_path / "other", ["color"], 2, seed=5)
    with pytest.raises(SuiteError):
        run_intervention(copy, ImageSwap(items=1), ReplayFiles(other.folder), load=lambda *_: twin)
    with pytest.raises(UnknownCategoryError, match="color, shape"):
        run_intervention(copy, ImageSwap(categories=("colour",)), source, load=lambda *_: twin)
    with pytest.raises(UsageError, match="at least 1"):
        ImageSwap(items=0)


def test_a_folder_called_embedded_is_not_taken_for_the_checkpoint_of_the_package(
    copy: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "embedded").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_policy_of(copy, ReplayFiles()).card.weights_sha256 == copy.weights_sha256


def test_the_seed_of_untrained_weights_is_that_of_the_run_unless_another_is_named(copy: Run) -> None:
    assert copy.origins[0].random_weights
    assert load_policy_of(copy, ReplayFiles()).card.weights_sha256 == copy.weights_sha256
    run = open_run(copy.path)
    run.__dict__["origins"] = (replace(copy.origins[0], weights_seed=7),)
    assert load_policy_of(run, ReplayFiles()).card.weights_seed == 7
    assert load_policy_of(run, ReplayFiles(weights_seed=8)).card.weights_seed == 8


def test_files_of_the_scene_are_those_of_the_run_as_long_as_they_are_there(
    copy: Run, twin: "Policy", tmp_path: Path
) -> None:
    photo = tmp_path / "photo.png"
    Image.new("RGB", (64, 48), "white").save(photo)
    scene = replace(SceneSpec.from_json(copy.settings["scene"]), rendering="visual-matching", background=photo)
    run = open_run(copy.path)
    run.settings = {**run.settings, "scene": scene.to_json()}
    settings = ExtractSettings("pi0-tiny", scene=scene)
    run.__dict__["origins"] = (origin_of_process(settings, {}),)
    with open_session(run, ReplayFiles(), lambda *_: twin) as session:
        assert session.scene.background == photo
    photo.unlink()
    with pytest.raises(SceneError, match="background"):
        open_session(run, ReplayFiles(), lambda *_: twin)


@pytest.mark.parametrize("where", ["drawn again", "found among more items"])
def test_without_a_named_suite_the_embedded_one_is_found_or_drawn_again(
    where: str, copy: Run, twin: "Policy", tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from probe_kit.suite import build_suite
    from probe_kit.suite.build import default_folder

    monkeypatch.setenv("PROBE_KIT_CACHE", str(tmp_path))
    if where == "found among more items":
        build_suite(default_folder(["color", "shape"]), ["color", "shape"], 14)
    run = open_run(copy.path)
    run.__dict__["origins"] = ()  # as of a run from another machine
    with open_session(
        run, ReplayFiles(), lambda *_: twin
    ) as session:  # the first frames are the run's, or this raises
        assert len(session.pairs(str(copy.episodes["item_id"].iloc[0]))) == 2
    assert len(list((tmp_path / "suites").iterdir())) == 1


@pytest.mark.parametrize(
    ("changed", "why"),
    [({"weights_sha256": None}, "scripted"), ({"ask": {}}, "asked"), ({"capture_only": True}, "only captured"),
     ({"edits": [{}]}, "edited"), ({"ask": {}, "weights_sha256": None}, "asked")],
)  # fmt: skip
def test_a_policy_that_did_not_act_is_not_intervened_on(copy: Run, changed: dict[str, object], why: str) -> None:
    run = open_run(copy.path)
    run.settings = {**run.settings, **changed}
    with pytest.raises(UsageError, match=why):
        run_intervention(run, ImageSwap(items=1))
