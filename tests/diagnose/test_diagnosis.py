"""`probe-kit diagnose` on the embedded policy, and on organisms made of it whose answer is known by construction.

The policy decides Color by what block 2 hands over (`kv.02`), and nothing reads its last backbone layer.
"""

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from typer.testing import CliRunner

import probe_kit as pk
from probe_kit.cli import app
from probe_kit.diagnose.diagnosis import FILE, FORMAT, diagnose_run, load_diagnosis, with_inputs_of
from probe_kit.diagnose.inputs import frames_of, read_paraphrases
from probe_kit.diagnose.results import Diagnosis
from probe_kit.env import SceneSpec
from probe_kit.errors import RunDamagedError, UsageError
from probe_kit.extract import ExtractSettings, LeRobotSource, extract_run
from probe_kit.hooks import Interventions, Policy
from probe_kit.hooks.families.pi0.adapter import load_pi0_tiny
from probe_kit.intervene.open_session import open_session
from probe_kit.intervene.sessions import ReplayFiles
from probe_kit.runs import Run, verify_run
from probe_kit.runs.layout import DIAGNOSES
from probe_kit.runs.results import write_bundle
from probe_kit.runs.store import locate
from probe_kit.suite import Suite
from tests.support.lerobot_recordings import CAMERA, write_recording
from tests.support.made_once import made_once
from tests.support.organisms import ORGANISMS, edited, make_deaf

FRAMES = ("--frames", "8")


def run_command(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["diagnose", *map(str, arguments)])


@pytest.fixture(scope="module")
def folder(two_steps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    def make(diagnosed: Path) -> None:
        policy = ("--checkpoint", two_steps, "--categories", "color", "--items", 16, "--env-workers", 0)
        new = (*policy, "--out", diagnosed / "run")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("probe_kit.diagnose.measure.DONORS", 2)
            answer = run_command("pi0-tiny", *new, *FRAMES, "--html", diagnosed / "why.html", "--format", "json")
        assert answer.exit_code == 0, answer.output
        (diagnosed / "first.json").write_text(answer.stdout, encoding="utf-8")

    return made_once(tmp_path_factory, "diagnosed", make)


@pytest.fixture(scope="module")
def run(folder: Path) -> Run:
    return pk.open_run(folder / "run")


@pytest.fixture(scope="module")
def run_of_many(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of enough groups for probes, and for a difference of two checkpoints."""
    settings = ExtractSettings("pi0-tiny", categories=("color",), items=24, capture_only=True, env_workers=0)
    return extract_run(settings, tmp_path_factory.mktemp("many") / "run")


@pytest.fixture(scope="module")
def diagnosis(folder: Path) -> dict[str, Any]:
    answer: dict[str, Any] = json.loads((folder / "first.json").read_text(encoding="utf-8"))
    return answer


def test_words_and_pictures_decide_color_and_pass_by_one_block(diagnosis: dict[str, Any]) -> None:
    inputs = {entry["name"]: entry for entry in diagnosis["inputs"]}
    assert inputs["state"]["verdict"] == "not varied"
    for name in ("instruction", "picture"):
        assert inputs[name]["verdict"] in ("decides", "moves"), "8 frames do not always tell them apart"
        assert inputs[name]["share"] > 0.5
    carried = {site["name"]: site["carried"] for site in inputs["instruction"]["passage"]}
    assert carried["kv.02"] > 0.9
    assert abs(carried["kv.01"]) < 0.1
    assert carried["backbone.03"] == 0, "nothing reads it"
    assert "kv.02" in inputs["picture"]["where"]


@pytest.mark.slow
def test_the_same_command_reads_what_is_stored_and_the_run_stays_sound(folder: Path, run: Run) -> None:
    answer = run_command(folder / "run", *FRAMES, "--format", "json")
    assert answer.exit_code == 0
    assert json.loads(answer.stdout) == json.loads((folder / "first.json").read_text(encoding="utf-8"))
    key = json.loads(answer.stdout)["key"]
    assert load_diagnosis(run, key).to_json() == json.loads(answer.stdout)
    assert not verify_run(folder / "run", deep=True).problems


def test_a_diagnosis_with_fields_of_another_version_is_refused_with_what_to_do(tmp_path: Path) -> None:
    run, key = cast("Run", SimpleNamespace(location=locate(tmp_path))), "0123456789ab"
    fields = {"key": key, "label": "mine", "n_frames": 1, "n_groups": 1, "inputs": [{"place": "backbone.00"}]}
    head = {"settings": {"format": FORMAT}}
    write_bundle(run.location, DIAGNOSES, key, head, {FILE: json.dumps(fields).encode()})
    with pytest.raises(RunDamagedError) as refusal:
        load_diagnosis(run, key)
    assert str(refusal.value).endswith(
        f"diagnosis.json has other fields: another version of probe_kit made it. Remove diagnoses/{key} and "
        "run the same `probe-kit diagnose` again"
    )


def test_the_page_has_the_table_the_sentences_and_the_figure(folder: Path) -> None:
    page = (folder / "why.html").read_text(encoding="utf-8")
    assert "carried by backbone.00" in page
    assert "data:image/png;base64," in page
    assert "http:" not in page
    assert "https:" not in page


def test_the_inputs_of_require_decide_the_exit_code(folder: Path) -> None:
    assert run_command(folder / "run", *FRAMES, "--require", "instruction,picture").exit_code == 0
    assert run_command(folder / "run", *FRAMES, "--require", "state").exit_code == 1, "it was not varied"
    answer = run_command(folder / "run", *FRAMES, "--require", "wrist")
    assert answer.exit_code == 2
    assert "instruction, picture, state" in answer.output


def test_an_input_that_no_model_has_is_refused_before_anything_is_played(tmp_path: Path) -> None:
    answer = run_command("pi0-tiny", "--require", "words", "--out", tmp_path / "run")
    assert (answer.exit_code, "no input is called 'words'" in answer.output) == (2, True)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "mention"),
    [
        (("--items", 6), "frames of 3 groups; a diagnosis needs at least 6"),
        (("--target", "sim.tool_y"), "Diagnose a run of `probe-kit extract` that acted"),
        (("--target", "side.chosen"), "Diagnose a run of `probe-kit extract` that acted"),
        (("--target", "dataset.x"), "built-in columns here are called item.NAME"),
        (("--html", "."), "is a folder"),
    ],
)
@pytest.mark.parametrize("plan", [(), ("--dry-run",)], ids=["run", "plan"])
def test_diagnose_refuses_what_needs_no_weights_before_they_are_loaded_and_in_the_plan(
    options: tuple[object, ...],
    mention: str,
    plan: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("probe_kit.hooks.load_policy", never)
    answer = run_command("pi0-tiny", "--categories", "color", "--out", tmp_path / "run", *options, *plan)
    assert (answer.exit_code, mention in " ".join(answer.output.split())) == (2, True), answer.output
    assert not (tmp_path / "run").exists()


def test_a_scripted_model_is_refused_before_it_plays(tmp_path: Path) -> None:
    answer = run_command("expert", "--categories", "color", "--out", tmp_path / "run")
    assert (answer.exit_code, "is scripted and has no network" in answer.output) == (2, True)
    assert not (tmp_path / "run").exists()


def test_a_stored_run_of_a_family_that_is_not_installed_is_refused_by_its_name(little_runs: Path) -> None:
    answer = run_command(little_runs / "run")
    assert answer.exit_code == 2, answer.output
    assert "unknown model 'little'" in answer.output


def test_a_camera_that_a_run_has_not_is_refused_before_its_model_is_loaded(folder: Path) -> None:
    answer = run_command(folder / "run", "--require", "picture.wrist", "--base", "no/such-model")
    assert (answer.exit_code, "there are instruction, picture, state" in answer.output) == (2, True)


def never(*_: object, **__: object) -> Policy:
    raise AssertionError("no model is loaded for a request that is wrong")


@pytest.mark.slow
@pytest.mark.parametrize("option", [("--require", "picture.wrist"), ("--base", "nowhere"), ("--pairs", "{pairs}")])
def test_diagnose_refuses_bad_settings_of_a_new_run_before_it_plays(
    option: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = tmp_path / "pairs.csv"
    pairs.write_text("episode,frame,donor_episode,donor_frame\ncolor-000,0,color-001,0\n", encoding="utf-8")
    if option[0] == "--require":
        monkeypatch.setattr("probe_kit.hooks.load_policy", never)
    monkeypatch.setattr("probe_kit.extract.extraction.Extraction.run", never)
    new = ("--categories", "color", "--items", 12, "--env-workers", 0, "--out", tmp_path / "run")
    answer = run_command("pi0-tiny", *new, option[0], option[1].format(pairs=pairs))
    assert answer.exit_code in (2, 3), answer.output
    reason = {
        "--require": "there are instruction, picture, state",
        "--base": "nowhere",
        "--pairs": "no frame 0 of",
    }
    assert reason[option[0]] in " ".join(answer.output.split())


@pytest.mark.slow
def test_pairs_of_a_table_are_the_ones_that_are_exchanged(run: Run) -> None:
    first = run.episodes.groupby("item_id", sort=False).first().reset_index()
    names = [str(name) for name in first["episode_id"]]
    donors = {name: names[(at + 3) % len(names)] for at, name in enumerate(names)}
    table = tuple((name, 0, donor, 0) for name, donor in donors.items())
    diagnosis = diagnose_run(run, pairs=table, inputs=["instruction", "state"], inside=False)
    words, state = diagnosis.inputs
    texts = dict(zip(run.episodes["episode_id"].astype(str), run.episodes["instruction"], strict=True))
    assert words.n_pairs == sum(texts[name] != texts[donor] for name, donor in donors.items())
    assert words.share > 0.3, "words decide Color"
    assert state.verdict == "not varied"
    assert diagnosis.n_frames == len(table)
    assert diagnosis.key != diagnose_run(run, pairs=table[:-1], inputs=["state"], inside=False).key


def test_a_pair_of_an_unknown_frame_is_refused_before_the_model_is_loaded(run: Run) -> None:
    name = str(run.episodes["episode_id"].iloc[0])
    with pytest.raises(UsageError, match=rf"no frame 3 of '{name}'.* it has of that episode 0"):
        diagnose_run(run, pairs=[(name, 3, name, 0)], load=never)
    with pytest.raises(UsageError, match=r"no frame 0 of 'nothing'.* episodes such as 'a2a-embedded-color"):
        diagnose_run(run, pairs=[("nothing", 0, name, 0)], load=never)
    with pytest.raises(UsageError, match="no input is called 'words'"):
        diagnose_run(run, inputs=["words"], load=never)


@pytest.mark.slow
def test_a_table_of_few_groups_and_one_beside_a_number_of_frames_are_refused(folder: Path, tmp_path: Path) -> None:
    first, second = pk.open_run(folder / "run").episodes["episode_id"].astype(str)[:2]
    pairs = tmp_path / "pairs.csv"
    pairs.write_text(f"episode,frame,donor_episode,donor_frame\n{first},0,{second},0\n", encoding="utf-8")
    answer = run_command(folder / "run", "--pairs", pairs)
    assert (answer.exit_code, "the table of pairs has frames of 1 group;" in answer.output) == (2, True)
    answer = run_command(folder / "run", "--pairs", pairs, *FRAMES)
    assert (answer.exit_code, "leave one of both out" in answer.output) == (2, True)


def test_settings_of_a_new_run_are_refused_for_a_stored_one(folder: Path) -> None:
    answer = run_command(folder / "run", "--categories", "color")
    assert answer.exit_code == 2
    assert "--categories is a setting of a new run" in answer.output


@pytest.mark.slow
def test_a_plan_says_how_many_inferences_it_takes_and_plays_nothing(tmp_path: Path) -> None:
    new = ("--categories", "color", "--out", tmp_path / "run", "--dry-run")
    answer = run_command("pi0-tiny", *new)
    assert answer.exit_code == 0
    assert "inferences" in answer.output
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--dry-run",), ("--require", "picture")], ids=" ".join)
def test_a_scripted_policy_has_nothing_to_diagnose(
    options: tuple[str, ...], small_suite: Suite, tmp_path: Path
) -> None:
    settings = ExtractSettings(
        "idle",
        suite=small_suite.folder,
        categories=("color",),
        items=2,
        scene=SceneSpec(max_steps=1),
        env_workers=0,
    )
    extract_run(settings, tmp_path / "run")
    answer = run_command(tmp_path / "run", *options)
    assert answer.exit_code == 2
    assert "idle is scripted and has no network; diagnose a policy" in " ".join(answer.output.split())


def test_too_few_groups_are_refused_with_their_number(run: Run) -> None:
    with pytest.raises(UsageError, match="frames of 3 groups"):
        diagnose_run(run, frames=3)


def test_csv_and_markdown_have_a_whole_line_for_every_input(folder: Path) -> None:
    answer = run_command(folder / "run", *FRAMES, "--format", "csv")
    rows = list(csv.DictReader(answer.stdout.splitlines()))
    assert [row["name"] for row in rows] == ["instruction", "picture", "state"]
    assert all(None not in row and None not in row.values() for row in rows), "no line is cut"
    lines = run_command(folder / "run", *FRAMES, "--format", "markdown").stdout.splitlines()
    assert sum(line.startswith("|") for line in lines) == 2 + len(rows)
    assert all(line.endswith("|") for line in lines if line.startswith("|"))


def test_paraphrases_must_differ(tmp_path: Path, folder: Path) -> None:
    file = tmp_path / "other.csv"
    file.write_text("instruction,other\nlift it,lift it\n", encoding="utf-8")
    answer = run_command(folder / "run", "--paraphrases", file)
    assert answer.exit_code == 2
    assert "line 2" in answer.output


@pytest.mark.slow
def test_recordings_of_the_same_frames_have_the_same_diagnosis(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="the extra `datasets` is not installed")
    with open_session(run, ReplayFiles()) as session, session.ready():
        frames = frames_of(session, 8)
    write_recording(tmp_path / "frames", [[frame.observation] for frame in frames])
    source = LeRobotSource(str(tmp_path / "frames"), cameras={"base": CAMERA})
    recorded = extract_run(ExtractSettings("pi0-tiny", source=source), tmp_path / "run")
    diagnosis = diagnose_run(recorded, frames=8)
    carried = {site.name: site.carried for site in diagnosis.inputs[0].passage}
    assert carried["kv.02"] > 0.9
    assert carried["backbone.03"] == 0
    assert (diagnosis.n_frames, diagnosis.n_groups) == (8, 8)
    shares = {diagnosed.name: diagnosed.share for diagnosed in diagnosis.inputs}
    assert shares["instruction"] > 0.5
    assert shares["picture"] > 0.5
    assert verdicts(diagnosis)["state"] == "not varied"


def test_paraphrases_are_read_by_the_rules_of_all_tables_and_do_not_contradict(tmp_path: Path) -> None:
    file = tmp_path / "other.csv"
    file.write_bytes("other;instruction\n grasp it ;lift it\n".encode("utf-16"))
    assert read_paraphrases(file) == {"lift it": "grasp it"}
    file.write_text("instruction,other\nlift it,grasp it\nlift it,raise it\n", encoding="utf-8")
    with pytest.raises(UsageError, match="line 3 has 'raise it' for 'lift it', and a line above has 'grasp it'"):
        read_paraphrases(file)


@pytest.mark.slow
def test_a_model_that_cannot_be_patched_is_tested_for_what_arrives_and_matters(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("probe_kit.hooks.families.pi0.adapter.Pi0.interventions", Interventions())
    diagnosis = diagnose_run(run, frames=8, seed=3)
    words, picture, _ = diagnosis.inputs
    for diagnosed in (words, picture):
        assert diagnosed.share > 0.5
        assert diagnosed.passage == ()
        assert diagnosed.where.startswith("sites were not patched: pi0-tiny does not support")


# -- knowledge and the base -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_target_is_probed_at_the_sites_that_are_patched(run_of_many: Run) -> None:
    answer = run_command(run_of_many.location, *FRAMES, "--target", "side.correct", "--format", "json")
    knowledge = json.loads(answer.stdout)["knowledge"]
    sites = {site["name"]: site for site in knowledge["sites"]}
    assert sites["backbone.00"]["score"] < sites["backbone.03"]["score"]
    assert sites["expert.03"]["signal"], "the side decides the action"
    assert set(sites) < {site["name"] for site in json.loads(answer.stdout)["inputs"][0]["passage"]}, "and kv"
    assert pk.load_results(run_of_many).key == knowledge["key"]


@pytest.mark.slow
def test_diagnose_separates_an_answer_that_no_site_encodes_from_one_that_is_lost(
    run_of_many: Run, tmp_path: Path
) -> None:
    episodes = run_of_many.episodes
    # Heads and tails in turn: no site comes near to signal (p 0.9), where a drawn coin came to p 0.04.
    groups = {group: number % 2 for number, group in enumerate(sorted(set(episodes["group_id"])))}
    coin = [["heads", "tails"][groups[group]] for group in episodes["group_id"]]
    table = tmp_path / "coin.csv"
    episodes[["episode_id"]].assign(coin=coin).to_csv(table, index=False)
    new = ("--target", "coin", "--labels", table, "--no-inside")
    answer = run_command(run_of_many.location, *FRAMES, *new)
    assert answer.exit_code == 0, answer.output
    assert "coin cannot be read anywhere" in " ".join(answer.output.split())


def test_a_table_without_a_target_is_refused(folder: Path) -> None:
    answer = run_command(folder / "run", "--labels", "coin.csv")
    assert (answer.exit_code, "name the column" in answer.output) == (2, True)


@pytest.mark.slow
def test_what_fine_tuning_lost_is_found_in_the_same_pairs_of_the_base(run_of_many: Run) -> None:
    compared = diagnose_run(
        run_of_many, frames=12, inputs=["instruction"], inside=False, base="before", load=edited(make_deaf), seed=3
    )
    (words,) = compared.inputs
    assert words.base is not None
    assert (words.base.change, words.base.verdict in ("decides", "moves")) == ("lost in fine-tuning", True)
    assert words.base.difference == pytest.approx(words.share - words.base.share)
    assert compared.exit_code() == 1


@pytest.mark.slow
def test_a_base_with_another_state_or_camera_is_refused() -> None:
    tuned, base = load_pi0_tiny(), load_pi0_tiny()
    assert with_inputs_of(tuned, base) is base

    class Wide(type(base)):  # type: ignore[misc]
        state_numbers = 32

    base.__class__ = Wide
    with pytest.raises(UsageError, match="its numbers of the state are 32, those of embedded 8"):
        with_inputs_of(tuned, base)
    base.__class__ = type(tuned)
    base.card = replace(base.card, cameras=("wrist",))
    base.with_cameras = lambda cameras: Policy.with_cameras(base, cameras)  # type: ignore[method-assign]
    with pytest.raises(UsageError, match=r"its cameras are .'wrist',"):
        with_inputs_of(tuned, base)


# -- organisms ----------------------------------------------------------------------------------------------


def verdicts(diagnosis: Diagnosis) -> dict[str, str]:
    return {diagnosed.name: diagnosed.verdict for diagnosed in diagnosis.inputs}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["blind", "deaf", "deaf inside", "state only"])
def test_the_loss_in_an_organism_is_found_and_where_it_is(run: Run, name: str) -> None:
    organism = ORGANISMS[name]
    diagnosis = diagnose_run(
        run,
        frames=8,
        inputs=tuple(organism.where),
        load=edited(organism.edit),
        # The weights that a diagnosis is stored under are those before the edit: the seed keeps organisms apart.
        seed=1 + list(ORGANISMS).index(name),
    )
    for diagnosed in diagnosis.inputs:
        assert diagnosed.verdict in organism.truth[diagnosed.name]
        assert organism.where[diagnosed.name] in diagnosed.where
    assert diagnosis.exit_code() == 1


@pytest.mark.slow
def test_an_untrained_policy_uses_nothing(tmp_path: Path) -> None:
    new = ("--categories", "color", "--random-weights", "--no-inside", "--out", tmp_path / "run")
    answer = run_command("pi0-tiny", *new, "--format", "json")
    assert answer.exit_code == 1
    assert {entry["verdict"] for entry in json.loads(answer.stdout)["inputs"]} <= {
        "no effect",
        "open",
        "not varied",
    }


@pytest.mark.slow
def test_neither_words_nor_pictures_decide_what_the_seed_does(tmp_path: Path) -> None:
    new = ("--categories", "state", "--no-inside", "--out", tmp_path / "run")
    answer = run_command("pi0-tiny", *new, "--format", "json")
    inputs = {entry["name"]: entry["verdict"] for entry in json.loads(answer.stdout)["inputs"]}
    assert set(inputs.values()) <= {"moves", "no effect", "open", "not varied"}
