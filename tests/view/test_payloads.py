"""Payloads hold the numbers and words of the run, its probes and its table, and no text that a page obeys."""

import csv
import json
import shutil
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.diagnose.diagnosis import FILE, FORMAT
from probe_kit.diagnose.results import Diagnosis, InputDiagnosis
from probe_kit.env.scoring import EVENTS, RULES, Events, Trajectory
from probe_kit.errors import RunDamagedError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.kinds.image_swap import ImageSwap, stored_image_swaps
from probe_kit.intervene.kinds.knockout import Knockout
from probe_kit.intervene.outcomes import ConditionOutcomes
from probe_kit.intervene.results import save
from probe_kit.intervene.settings import settings_of
from probe_kit.intervene.stored import stored_interventions
from probe_kit.retention import retention_table
from probe_kit.runs import Run, open_run
from probe_kit.runs.layout import DIAGNOSES
from probe_kit.runs.records import as_json
from probe_kit.runs.results import write_bundle
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import as_thumbnail, decode_frames, thumbnail_key
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import Suite
from probe_kit.train import Target, load_results, train_probes
from probe_kit.train.results.probe_results import read_directions
from probe_kit.train.results.store import load_results_by_call
from probe_kit.view import write_viewer
from probe_kit.view.catalogue import Catalogue
from probe_kit.view.run_payloads import pack_floats, pack_log_odds, payload_script
from tests.intervene.answers import knockout_of
from tests.retention.asked_runs import ASK
from tests.support.little_run import certify, episode, little_plan, little_settings, little_writer
from tests.support.recorded_run import CALLS, EVERY, write_recorded_run
from tests.view.payload_reader import floats, log_odds, read_payload, words


def payload(catalogue: Catalogue, name: str):
    payload_name, value = read_payload(catalogue.script(name))
    assert payload_name == name
    return value


def test_log_odds_at_inference_0_are_the_stored_out_of_fold_decisions(catalogue: Catalogue) -> None:
    viewed = catalogue.runs["run"]
    curve = load_results(viewed.run).curves["color", "mean"]
    for row, (name, label) in enumerate(zip(curve.episodes, curve.labels, strict=True)):
        position = viewed.run.episodes["episode_id"].tolist().index(name)
        values, held_out = viewed.probes["color"].log_odds(position)
        expected = curve.decisions[:, row] * (1 if label else -1)
        assert held_out
        np.testing.assert_allclose(values, [expected], rtol=1e-6, atol=1e-6)


def test_an_episode_says_how_its_sheet_is_divided_and_what_its_prompt_lost(
    small_suite: Suite, tmp_path: Path
) -> None:
    plan = little_plan(small_suite)
    writer = little_writer(locate(tmp_path / "run"), plan)
    frames = tuple(np.zeros((60, 80, 3), np.uint8) for _ in range(10))
    pictures = {thumbnail_key(0): as_thumbnail(frames, "all")}
    writer.write(replace(episode(plan, 0), pictures=pictures, frames=10))
    cut = episode(plan, 1)
    writer.write(replace(cut, outcome={**cut.outcome, "lost_words": 2}))
    catalogue = Catalogue([open_run(tmp_path / "run", allow_partial=True)])
    size = {"width": 80, "height": 60}
    assert payload(catalogue, "run/e/00000")["frames"] == {
        "count": 10,
        "columns": 8,
        **size,
        "all": True,
        "steps": None,
    }
    assert payload(catalogue, "run/e/00001")["frames"] == {
        "count": 2,
        "columns": 2,
        **size,
        "all": False,
        "steps": None,
    }
    assert catalogue.picture("run", 0) == pictures[thumbnail_key(0)]
    assert [payload(catalogue, f"run/e/0000{number}")["lost_words"] for number in (0, 1)] == [0, 2]


def test_an_episode_says_how_its_action_responds_to_the_stored_image_swap(
    catalogue: Catalogue, little: Run
) -> None:
    (stored,) = stored_interventions(little, "image-swap")
    outcomes = stored.outcomes
    expected = {}
    for number, name in enumerate(outcomes.episodes):
        goes_left = outcomes.displacement[:, number] > 0
        goes_right = goes_left == (outcomes.sides[number] == "left")
        expected[str(name)] = 0 if goes_left[0] == goes_left[1] else 1 if goes_right[0] else -1
    episode_list = payload(catalogue, "run/episodes")
    assert dict(zip(episode_list["id"], episode_list["swap"], strict=True)) == expected
    assert set(expected.values()) == {-1, 0, 1}
    shares = {name: list(expected.values()).count(value) / 24 for name, value in (("follow", 1), ("reversal", -1))}
    effect = stored_image_swaps(little)["color"]
    assert (effect.follow_rate, effect.reversal_rate) == pytest.approx((shares["follow"], shares["reversal"]))


def test_an_item_that_no_fold_tests_takes_the_mean_of_the_folds_and_is_marked(little: Run) -> None:
    catalogue = Catalogue([little])
    viewed = catalogue.runs["run"]
    probes, results = viewed.probes["color"], viewed.results
    assert results is not None
    probes._fold_of.clear()
    values, held_out = probes.log_odds(0)
    assert not held_out
    side = 1 if little.episodes["side_correct"].iloc[0] == "left" else -1
    for row, site in enumerate(probes.sites):
        direction = results.direction("color", "mean", site)
        by_fold = direction.weights.astype(np.float64) @ little.column(site)[0] + direction.intercepts
        assert values[0, row] == pytest.approx(side * by_fold.mean(), rel=1e-6, abs=1e-6)


def test_directions_read_at_once_are_those_read_one_by_one(little: Run) -> None:
    results = load_results(little)
    places = [("color", "mean", site) for site in results.curves["color", "mean"].sites]
    together = read_directions(results.directions, places)
    for column_key in places:
        alone = results.directions[column_key]
        assert all(np.array_equal(value, vars(together[column_key])[name]) for name, value in vars(alone).items())
    with pytest.raises(KeyError):
        read_directions(results.directions, [("color", "mean", Site("backbone", 77))])


def test_the_rows_are_spelt_as_in_the_table(catalogue: Catalogue, little: Run) -> None:
    table = payload(catalogue, "run/run")["table"]
    markdown = retention_table([little]).to_markdown()
    headings = [column["heading"] for column in table["columns"]]
    assert headings == ["SR % [95 %]", "backbone % [95 %]", "in the backbone", "action % [95 %]", "in the action",
                        "retention [95 %]", "used"]  # fmt: skip
    assert [row["category"] for row in table["rows"]] == ["color", "mean"]
    for row in table["rows"]:
        for heading, cell in zip(headings, row["cells"], strict=True):
            assert heading in markdown
            assert cell["text"].replace("–", "") in markdown


def test_overview_and_maps_read_no_trajectory(
    catalogue: Catalogue, little: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("run/run", "run/episodes", "run/map/color")
    expected = [catalogue.script(name) for name in names]
    monkeypatch.delattr(Trajectory, "of_frames")
    again = Catalogue([open_run(little.location.address)])
    assert [again.script(name) for name in names] == expected
    with pytest.raises(AttributeError):
        again.script("run/e/00003")


def test_the_cells_of_a_map_are_the_stored_scores(catalogue: Catalogue, little: Run) -> None:
    results = load_results(little)
    stored = little.location.read(f"probes/{results.key}/scores.csv").decode()
    rows = [row for row in csv.DictReader(StringIO(stored)) if row["view"] == "mean"]
    color_map = payload(catalogue, "run/map/color")
    assert len(color_map["cells"]) == len(rows) == len(payload(catalogue, "run/run")["sites"])
    for cells, row, signal in zip(color_map["cells"], rows, color_map["signal"], strict=True):
        share, low, high = (f"{100 * float(row[name]):.1f}" for name in ("accuracy", "ci_low", "ci_high"))
        assert cells[0] == f"{share} [{low}, {high}]"
        assert cells[1:3] == [f"{float(row['p']):.3f}", f"{float(row['p_fwe']):.3f}"]
        assert cells[4] == f"{100 * float(row['control_accuracy']):.1f}"
        assert signal == (row["signal"] == "True")


def test_the_log_odds_of_a_map_are_the_curves_with_the_correct_side_up(catalogue: Catalogue, little: Run) -> None:
    curve = load_results(little).curves["color", "mean"]
    color_map = payload(catalogue, "run/map/color")
    mapped_episodes = little.episodes["episode_id"].iloc[color_map["rows"]]
    assert mapped_episodes.tolist() == curve.episodes.tolist()
    values = log_odds(color_map["log_odds"]).reshape(len(curve.sites), -1)
    np.testing.assert_allclose(values, curve.decisions * np.where(curve.labels, 1, -1), atol=0.002)


def test_the_episodes_are_those_of_the_run(catalogue: Catalogue, little: Run) -> None:
    episode_list, episodes = payload(catalogue, "run/episodes"), little.episodes
    assert episode_list["number"] == episodes["episode"].tolist()
    assert episode_list["id"] == episodes["episode_id"].tolist()
    assert episode_list["steps"] == episodes["steps"].tolist()
    for name in ("instruction", "outcome", "side_correct", "side_placed", "layout", "category"):
        assert words(episode_list[name]) == episodes[name].tolist()
    best = payload(catalogue, "run/run")["categories"][0]["best"]
    assert best["backbone"]["signal"] == retention_table([little]).rows[0].backbone.has_signal
    curve = load_results(little).curves["color", "mean"]
    expected = curve.decisions[curve.best("expert")] * np.where(curve.labels, 1, -1)
    np.testing.assert_allclose(log_odds(episode_list["log_odds"]["action"]), expected, atol=0.002)


def test_an_episode_holds_its_trajectory_events_and_outcomes(catalogue: Catalogue, little: Run) -> None:
    for number in (0, 7):
        record, trajectory = payload(catalogue, f"run/e/{number:05d}"), little.trajectory(number)
        assert np.array_equal(floats(record["trajectory"]["tool"]), trajectory.tool[:, :3].ravel())
        assert np.array_equal(floats(record["trajectory"]["commanded"]), trajectory.commanded[:, :3].ravel())
        assert np.array_equal(floats(record["trajectory"]["tiles"]["left"]), trajectory.tile_left[:, :2].ravel())
        assert record["trajectory"]["frames"] == len(trajectory)
        assert record["inferences"] == little.control_steps[number].tolist()
        assert record["events"] == {name: Events.of(trajectory).frame(name) for name in EVENTS}
        assert record["outcomes"] == {rule: little.judged(rule)["outcome"].iloc[number] for rule in RULES}
        assert (record["frames"] is not None) == (number == 0)


@pytest.mark.parametrize(
    "name",
    [
        "run/e/99999", "run/e/-0001", "run/e/0", "run/map/none", "run", "run/e", "other/run", "../run.json", "",
        "run/", "run/map/../run", "/etc/passwd",
    ],
)  # fmt: skip
def test_another_name_is_no_payload(catalogue: Catalogue, name: str) -> None:
    with pytest.raises(KeyError):
        catalogue.script(name)


def test_every_payload_that_is_named_can_be_made(catalogue: Catalogue) -> None:
    names = list(catalogue.names())
    assert names[:5] == ["index", "run/run", "run/episodes", "run/results", "run/map/color"]
    assert len(names) == 5 + 24
    for name in names:
        assert read_payload(catalogue.script(name))[0] == name


HOSTILE = "</script><img src=x onerror=alert(1)> \u202egnp.exe \x1b[31m ]]> <!-- \u2028 \ud800"


def test_no_text_ends_the_script_or_turns_the_line_round() -> None:
    script = payload_script("a/run", {"label": HOSTILE, "list": [HOSTILE], HOSTILE: 1})
    assert script.isascii()
    assert b"<" not in script
    _, value = read_payload(script)
    assert not set("\u202e\x1b\u2028\ud800") & set(value["label"])
    assert "</script>" in value["label"]


def test_packed_numbers_are_neither_text_nor_paths() -> None:
    values = np.random.default_rng(0).normal(size=4000)
    _, value = read_payload(payload_script("a", {"x": pack_floats(values), "path": "/home/jane/runs/x.zarr"}))
    assert np.array_equal(floats(value["x"]), values.astype(np.float32))
    assert value["path"] == "x.zarr"


def test_log_odds_are_exact_to_two_thousandths_and_missing_ones_stay_missing() -> None:
    values = np.array([0, 0.25, -3.1234, 126.9, -127.4, 5000, -5000, np.nan, np.inf])
    unpacked = log_odds(pack_log_odds(values))
    np.testing.assert_allclose(unpacked[:5], values[:5], atol=0.002)
    assert unpacked[5] == unpacked[8] == -unpacked[6] == pytest.approx(127.996, abs=0.001)
    assert np.isnan(unpacked[7])


def test_runs_of_one_name_have_names_of_their_own_and_none_is_shown_twice(
    little_runs: Path, tmp_path: Path
) -> None:
    for name in ("a", "b"):
        shutil.copytree(little_runs / ("run" if name == "a" else "other"), tmp_path / name / "My run")
    runs = [open_run(tmp_path / name / "My run") for name in ("a", "b")]
    assert list(Catalogue(runs).runs) == ["My-run", "My-run-2"]
    with pytest.raises(UsageError, match="given twice"):
        Catalogue([runs[0], runs[0]])
    with pytest.raises(UsageError, match="at least one run"):
        Catalogue([])


def test_a_picture_that_is_not_the_committed_one_is_refused_by_name(little_runs: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(little_runs / "run", tmp_path / "run")
    catalogue = Catalogue([open_run(folder)])
    assert catalogue.picture("run", 0) == (folder / thumbnail_key(0)).read_bytes()
    assert catalogue.picture("run", 5) is None
    (folder / thumbnail_key(0)).write_bytes(b"another picture")
    with pytest.raises(RunDamagedError, match=thumbnail_key(0)):
        catalogue.picture("run", 0)


def test_the_stamp_of_a_payload_names_commits_and_probes(little_runs: Path) -> None:
    runs = [open_run(little_runs / name) for name in ("run", "other")]
    single, both = Catalogue(runs[:1]), Catalogue(runs)
    assert single.stamp("run/run") == both.stamp("run/run") != both.stamp("other/run")
    assert single.stamp("index") != both.stamp("index")
    assert json.dumps(single.stamp("run/e/00000")) != json.dumps(single.stamp("run/e/00001"))


@pytest.mark.slow
def test_later_inferences_are_read_by_the_fold_that_tests_the_item_and_by_probes_of_their_own(
    runs: list[Run],
) -> None:
    catalogue, results = Catalogue(runs[:1]), load_results(runs[0])
    curves = {
        call: call_results.curves["color", "mean"]
        for call, call_results in load_results_by_call(runs[0], results).items()
    }
    curve = curves[0]
    features = {site: [runs[0].column(site, call=call) for call in range(2)] for site in curve.sites}
    for position, number in enumerate(runs[0].episodes["episode"]):
        record = payload(catalogue, f"a/e/{number:05d}")
        at = curve.episodes.tolist().index(runs[0].episodes["episode_id"].iloc[position])
        sign = 1 if curve.labels[at] else -1
        frozen, refitted = (log_odds(record[name]).reshape(2, -1) for name in ("log_odds", "refitted"))
        for row, site in enumerate(curve.sites):
            probe = results.direction("color", "mean", site)
            weights, intercept = (
                probe.weights[curve.fold_of[at]].astype(float),
                probe.intercepts[curve.fold_of[at]],
            )
            expected = [sign * (features[site][call][position] @ weights + intercept) for call in range(2)]
            np.testing.assert_allclose(frozen[:, row], expected, atol=0.003)
            stored = [sign * curves[call].decisions[row, curves[call].episodes.tolist().index(curve.episodes[at])]
                      for call in range(2)]  # fmt: skip
            np.testing.assert_allclose(refitted[:, row], stored, atol=0.003)


def test_a_model_that_was_asked_is_shown_with_question_and_answers_in_words(
    small_suite: Suite, tmp_path: Path
) -> None:
    plan = little_plan(small_suite.select(["color"]), 0, 2)
    settings = {**little_settings(), "ask": ASK}
    writer = RunWriter(locate(tmp_path / "run"), plan, settings)
    certify(writer)
    question_row = {
        "question": "Which one?\nA left\nB right",
        "answer": "Neither <b>",
        "said": "none",
        "parse": "none",
    }
    outcomes = {"outcome": "oob", "outcome_logits": "correct", "outcome_debiased": "wrong"}
    sides = {"side_placed": "none", "side_logits": "left", "side_debiased": "right"}
    measured = {"parse_tier": "none", "letter_bias": 0.1, "content": 1.0, "margin": 1.0, "option_mass": 0.9}
    marks = {"near_tie": False, "side_word": False}
    for number in range(2):
        record = episode(plan, number)
        outcome_fields = {**question_row, **outcomes, **sides, **measured, **marks}
        writer.write(replace(record, outcome={**record.outcome, **outcome_fields}))
    catalogue = Catalogue([open_run(tmp_path / "run", allow_partial=True)])
    assert payload(catalogue, "run/e/00000")["words"] == {
        "question": question_row["question"], "text": "Neither <b>", "option read": "none", "parsing rule": "none",
        "outcome, text": "unread", "outcome, logits": "correct", "outcome, order-balanced": "wrong",
    }  # fmt: skip
    assert words(payload(catalogue, "run/episodes")["outcome"]) == ["unread", "unread"]


WRITTEN = (0, 1, 5)


@pytest.fixture(scope="module")
def unfinished(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Three episodes with other activations than those of the small run."""
    where = tmp_path_factory.mktemp("unfinished") / "now"
    plan = little_plan(small_suite)
    writer = little_writer(locate(where), plan, seed=2)
    for number in WRITTEN:
        writer.write(episode(plan, number, seed=2))
    return open_run(where, allow_partial=True)


@pytest.fixture(scope="module")
def lent_catalogue(unfinished: Run, little: Run) -> Catalogue:
    return Catalogue([unfinished], little)


def read(lent_catalogue: Catalogue, name: str):
    return read_payload(lent_catalogue.script(name))[1]


def test_log_odds_are_of_the_runs_own_activations_and_held_out_by_item(
    lent_catalogue: Catalogue, unfinished: Run, little: Run
) -> None:
    results = load_results(little)
    curve = results.curves["color", "mean"]
    fold_of = dict(zip(curve.items.tolist(), curve.fold_of.tolist(), strict=True))
    for position, row in enumerate(unfinished.episodes.to_dict("records")):
        side = 1 if row["side_correct"] == "left" else -1
        expected = []
        for site in curve.sites:
            probe, fold = results.direction("color", "mean", site), fold_of[row["item_id"]]
            features = unfinished.rows(site.stream)[position][0][unfinished.stored(site.stream).at(site)][0]
            expected.append(side * (probe.weights[fold].astype(np.float64) @ features + probe.intercepts[fold]))
        payload = read(lent_catalogue, f"now/e/{row['episode']:05d}")
        assert payload["held_out"]
        np.testing.assert_allclose(log_odds(payload["log_odds"]), expected, atol=1 / 256)
        best = read(lent_catalogue, "now/run")["categories"][0]["best"]["backbone"]["site"]
        packed = read(lent_catalogue, "now/episodes")["log_odds"]["backbone"]
        np.testing.assert_allclose(log_odds(packed)[position], expected[best], atol=1 / 256)


def test_the_page_says_whose_probes_they_are_and_shows_their_scores(
    lent_catalogue: Catalogue, little: Run
) -> None:
    run = read(lent_catalogue, "now/run")
    assert run["probes_of"] == little.label
    assert [column["key"] for column in run["table"]["columns"]] == ["success.sr"], "no rate of lent probes"
    color_map = read(Catalogue([little]), "run/map/color")
    lent = read(lent_catalogue, "now/map/color")
    assert lent["cells"] == color_map["cells"]
    assert lent["rows"] == [0, 1, 2]
    assert read(Catalogue([little], little), "run/run")["probes_of"] is None


def test_probes_of_another_model_are_refused(small_suite: Suite, little: Run, tmp_path: Path) -> None:
    plan = little_plan(small_suite, episodes=2)
    writer = RunWriter(locate(tmp_path / "run"), plan, {**little_settings(), "weights_sha256": "1" * 64})
    certify(writer)
    writer.write(episode(plan, 0))
    other = open_run(tmp_path / "run", allow_partial=True)
    with pytest.raises(UsageError, match="other weights, 111111111111 instead of 000000000000"):
        Catalogue([other], little)
    with pytest.raises(UsageError, match="has no probes"):
        Catalogue([little], other)


def test_a_study_without_stored_runs_says_how_to_play_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    answer = CliRunner().invoke(app, ["view", "embedded", "--export", "page"])
    assert answer.exit_code != 0
    assert "probe-kit study run embedded" in " ".join(answer.stderr.split())


CONDITIONS = ("clean", "image_swap", "frame_swap", "control_input")


def swap_inputs(run: Run) -> str:
    """Store an exchange of pictures that does half of the exchange of all inputs."""
    settings = settings_of(ImageSwap(), run)
    episodes = run.episodes
    sizes = np.array([0.0, 0.5, 1.0, 0.01])[:, None] + np.linspace(0, 0.001, len(episodes))
    outcomes = ConditionOutcomes(
        CONDITIONS, *(episodes[name].to_numpy(str) for name in ("episode_id", "item_id", "group_id", "category")),
        np.full(len(episodes), ""), sizes, sizes, np.zeros((4, len(episodes), 5)), np.zeros(len(episodes)),
        toward=sizes, size=sizes,
    )  # fmt: skip
    check = {"replay": {"compared": 1, "equal": 1}}
    return save(run, settings, outcomes, check)


def diagnose(run: Run, version: str = FORMAT) -> str:
    """Store a diagnosis of one input that decides, and of one that does not arrive."""
    measured = InputDiagnosis("picture", "decides", "", 0.8, (0.6, 0.9), 0.01, 0.9, 0.001, 36, 6, 36)
    settings = {"format": version, "stamp": run.stamp}
    key = sha256_json(settings)[:12]
    diagnosis = Diagnosis(key, run.label, 12, 6, (measured,))
    write_bundle(run.location, DIAGNOSES, key, {"settings": settings}, {FILE: as_json(diagnosis.to_json())}, {})
    return key


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Twelve recorded episodes of four inferences, with probes, an intervention and a diagnosis."""
    run = write_recorded_run(tmp_path_factory.mktemp("recorded") / "run")
    train_probes(run, target=Target.of_run(run, "dataset.state.x"), permutations=20)
    swap_inputs(run)
    diagnose(run)
    return open_run(run.path)


@pytest.fixture(scope="module")
def source_catalogue(recorded: Run) -> Catalogue:
    return Catalogue([recorded])


@pytest.mark.slow
def test_a_run_of_recordings_opens_with_the_views_that_need_no_side(source_catalogue: Catalogue) -> None:
    _, run = read_payload(source_catalogue.script("run/run"))
    assert (run["sides"], run["views"]) == (False, ["overview", "map", "episodes"])
    assert (run["table"]["rows"], run["scene"], run["committed"]) == ([], None, 12)
    assert run["targets"] == [{"target": "dataset.state.x", "category": "all"}]
    for name in source_catalogue.names():
        assert read_payload(source_catalogue.script(name))[0] == name


def test_the_viewer_shows_stored_results_as_the_tables_of_the_commands(source_catalogue: Catalogue) -> None:
    _, results = read_payload(source_catalogue.script("run/results"))
    kinds = {table["kind"]: table for table in results["tables"]}
    assert list(kinds) == [
        "diagnosis of the inputs", "intervention image-swap", "probes of dataset.state.x", "predicted actions"
    ]  # fmt: skip
    swap = kinds["intervention image-swap"]
    assert [cell["text"] for cell in swap["rows"][0]][:2] == ["All", "picture"]
    assert swap["findings"] == ["All  decides: the action follows the picture, by 0.50 of what all inputs do."]
    assert kinds["diagnosis of the inputs"]["rows"][0][2]["text"] == "decides"
    assert [row[0]["text"] for row in kinds["predicted actions"]["rows"]] == ["dx", "grip"]


def test_a_knockout_has_a_chart_for_each_growth_of_its_windows(tmp_path: Path) -> None:
    run = write_recorded_run(tmp_path / "run")
    save(run, settings_of(Knockout(), run), knockout_of({"image": [{2}], "language": []}, 0), {"replay": {}})
    _, results = read_payload(Catalogue([open_run(run.path)]).script("run/results"))
    (charts,) = [table["curves"] for table in results["tables"] if table["kind"] == "intervention knockout"]
    assert [chart["title"] for chart in charts] == ["Color: cut up to the layer", "Color: cut from the layer"]
    lines = {line["name"]: line for line in charts[0]["lines"]}
    assert lines["image"]["read"] == [False, False, True, True, True, True]
    assert not any(lines["language"]["read"])
    assert charts[0]["layers"] == [0, 1, 2, 3, 4, 5]
    assert len(charts[0]["controls"]) == 6


def test_a_knockout_without_controls_has_a_chart_without_them(tmp_path: Path) -> None:
    run = write_recorded_run(tmp_path / "run")
    outcomes = knockout_of({"image": [{2}]}, 0)
    log = outcomes.edit_log.copy()
    log[[cell.is_control for cell in outcomes.cells]] = 0  # they cut nothing
    save(run, settings_of(Knockout(), run), replace(outcomes, edit_log=log), {"replay": {}})
    _, results = read_payload(Catalogue([open_run(run.path)]).script("run/results"))
    (charts,) = [table["curves"] for table in results["tables"] if table["kind"] == "intervention knockout"]
    assert [chart["controls"] for chart in charts] == [[None] * 6] * 2


@pytest.mark.slow
def test_a_diagnosis_of_another_version_is_refused_and_the_other_results_are_shown(tmp_path: Path) -> None:
    run = write_recorded_run(tmp_path / "run")
    keys = diagnose(run), diagnose(run, "probe_kit diagnosis 1")
    _, results = read_payload(Catalogue([open_run(run.path)]).script("run/results"))
    assert [(table["kind"], table["key"]) for table in results["tables"]] == [
        ("diagnosis of the inputs", keys[0]), ("predicted actions", "")
    ]  # fmt: skip
    (reason,) = results["refused"]
    assert f"{keys[1]}/settings.json has format probe_kit diagnosis 1; this version of probe_kit reads" in reason
    assert f"Remove diagnoses/{keys[1]} and run the same `probe-kit diagnose` again" in reason
    assert str(tmp_path) not in reason


def test_a_target_has_a_map_with_the_scores_of_its_probes(source_catalogue: Catalogue) -> None:
    _, target = read_payload(source_catalogue.script("run/target/0"))
    assert target["metric"] == "R²"
    assert target["score"].index(max(target["score"])) == 1, "the state was planted in the second layer"
    assert len(target["sites"]) == len(target["cells"]) == len(target["signal"])
    with pytest.raises(KeyError):
        source_catalogue.script("run/target/1")


def test_an_episode_shows_every_inference_and_predicted_beside_recorded_actions(
    recorded: Run, source_catalogue: Catalogue
) -> None:
    _, episode = read_payload(source_catalogue.script("run/e/00003"))
    steps = [EVERY * call for call in range(CALLS)]
    assert episode["inferences"] == episode["frames"]["steps"] == steps
    assert recorded.inputs is not None
    actions = episode["inputs"][0]
    assert [series["name"] for series in actions["series"]] == ["dx", "grip"]
    for number, series in enumerate(actions["series"]):
        for line, kind in zip(series["lines"], ("action", "prediction"), strict=True):
            np.testing.assert_array_equal(floats(line["values"]), recorded.inputs.read(kind)[3, :, 0, number])
    picture = source_catalogue.picture("run", 3)
    assert picture is not None
    decoded = np.stack(list(decode_frames(picture, CALLS))).astype(float)
    pixels = recorded.inputs.read("pixels")[3, :, 0]
    np.testing.assert_allclose(decoded.mean(axis=(1, 2)), pixels.mean(axis=(1, 2)), atol=8)


@pytest.mark.slow
def test_an_export_of_recordings_is_the_same_bytes_again(recorded: Run, tmp_path: Path) -> None:
    contents = []
    for name in ("a", "b"):
        folder = write_viewer([recorded], tmp_path / name).parent
        files = [path for path in folder.rglob("*") if path.is_file()]
        contents.append({path.relative_to(folder): path.read_bytes() for path in files})
    assert contents[0] == contents[1]
    assert len([name for name in contents[0] if name.suffix == ".webp"]) == 12
