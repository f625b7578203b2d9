"""Payloads hold the numbers and words of the run, its probes and its table, and no text that a page obeys."""

import csv
import json
import shutil
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

from probe_kit.env.scoring import EVENTS, RULES, Events, Trajectory
from probe_kit.errors import RunDamagedError, UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.kinds.image_swap import stored_image_swaps
from probe_kit.intervene.outcomes import stored_interventions
from probe_kit.retention import retention_table
from probe_kit.runs import Run, open_run
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import Suite
from probe_kit.train import load_results
from probe_kit.train.results.probe_results import read_directions
from probe_kit.train.results.store import load_results_by_call
from probe_kit.view.catalogue import Catalogue
from probe_kit.view.run_payloads import pack_floats, pack_log_odds, payload_script
from tests.retention.asked_runs import ASK
from tests.support.little_run import certify, episode, little_plan, little_settings, little_writer
from tests.view.payload_reader import floats, log_odds, read_payload, words


def payload(catalogue: Catalogue, name: str):
    found, value = read_payload(catalogue.script(name))
    assert found == name
    return value


def test_log_odds_at_inference_0_are_the_stored_out_of_fold_decisions(catalogue: Catalogue) -> None:
    viewed = catalogue.runs["run"]
    curve = load_results(viewed.run).curves["color", "mean"]
    for place, (name, label) in enumerate(zip(curve.episodes, curve.labels, strict=True)):
        position = viewed.run.episodes["episode_id"].tolist().index(name)
        found = viewed.probes["color"].log_odds(position)
        expected = curve.decisions[:, place] * (1 if label else -1)
        assert found.held_out
        np.testing.assert_allclose(found.values, [expected], rtol=1e-6, atol=1e-6)


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
    outcomes = stored.outcomes()
    expected = {}
    for number, name in enumerate(outcomes.episodes):
        left = outcomes.displacement[:, number] > 0
        goes_right = left == (outcomes.sides[number] == "left")
        expected[str(name)] = 0 if left[0] == left[1] else 1 if goes_right[0] else -1
    found = payload(catalogue, "run/episodes")
    assert dict(zip(found["id"], found["swap"], strict=True)) == expected
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
    found = probes.log_odds(0)
    assert not found.held_out
    side = 1 if little.episodes["side_correct"].iloc[0] == "left" else -1
    for place, site in enumerate(probes.sites):
        own = results.direction("color", "mean", site)
        by_fold = own.weights.astype(np.float64) @ little.column(site)[0] + own.intercepts
        assert found.values[0, place] == pytest.approx(side * by_fold.mean(), rel=1e-6, abs=1e-6)


def test_directions_read_at_once_are_those_read_one_by_one(little: Run) -> None:
    results = load_results(little)
    places = [("color", "mean", site) for site in results.curves["color", "mean"].sites]
    together = read_directions(results.directions, places)
    for place in places:
        alone = results.directions[place]
        assert all(np.array_equal(value, vars(together[place])[name]) for name, value in vars(alone).items())
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
    found = payload(catalogue, "run/map/color")
    assert len(found["cells"]) == len(rows) == len(payload(catalogue, "run/run")["sites"])
    for cells, row, signal in zip(found["cells"], rows, found["signal"], strict=True):
        share, low, high = (f"{100 * float(row[name]):.1f}" for name in ("accuracy", "ci_low", "ci_high"))
        assert cells[0] == f"{share} [{low}, {high}]"
        assert cells[1:3] == [f"{float(row['p']):.3f}", f"{float(row['p_fwe']):.3f}"]
        assert cells[4] == f"{100 * float(row['control_accuracy']):.1f}"
        assert signal == (row["signal"] == "True")


def test_the_log_odds_of_a_map_are_the_curves_with_the_correct_side_up(catalogue: Catalogue, little: Run) -> None:
    curve = load_results(little).curves["color", "mean"]
    found = payload(catalogue, "run/map/color")
    shown = little.episodes["episode_id"].iloc[found["rows"]]
    assert shown.tolist() == curve.episodes.tolist()
    values = log_odds(found["log_odds"]).reshape(len(curve.sites), -1)
    np.testing.assert_allclose(values, curve.decisions * np.where(curve.labels, 1, -1), atol=0.002)


def test_the_episodes_are_those_of_the_run(catalogue: Catalogue, little: Run) -> None:
    found, episodes = payload(catalogue, "run/episodes"), little.episodes
    assert found["number"] == episodes["episode"].tolist()
    assert found["id"] == episodes["episode_id"].tolist()
    assert found["steps"] == episodes["steps"].tolist()
    for name in ("instruction", "outcome", "side_correct", "side_placed", "layout", "category"):
        assert words(found[name]) == episodes[name].tolist()
    best = payload(catalogue, "run/run")["categories"][0]["best"]
    assert best["backbone"]["signal"] == retention_table([little]).rows[0].backbone.has_signal
    curve = load_results(little).curves["color", "mean"]
    expected = curve.decisions[curve.best("expert")] * np.where(curve.labels, 1, -1)
    np.testing.assert_allclose(log_odds(found["log_odds"]["action"]), expected, atol=0.002)


def test_an_episode_holds_its_trajectory_events_and_outcomes(catalogue: Catalogue, little: Run) -> None:
    for number in (0, 7):
        found, trajectory = payload(catalogue, f"run/e/{number:05d}"), little.trajectory(number)
        assert np.array_equal(floats(found["trajectory"]["tool"]), trajectory.tool[:, :3].ravel())
        assert np.array_equal(floats(found["trajectory"]["commanded"]), trajectory.commanded[:, :3].ravel())
        assert np.array_equal(floats(found["trajectory"]["tiles"]["left"]), trajectory.tile_left[:, :2].ravel())
        assert found["trajectory"]["frames"] == len(trajectory)
        assert found["inferences"] == little.control_steps[number].tolist()
        assert found["events"] == {name: Events.of(trajectory).frame(name) for name in EVENTS}
        assert found["outcomes"] == {rule: little.judged(rule)["outcome"].iloc[number] for rule in RULES}
        assert (found["frames"] is not None) == (number == 0)


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
    found = log_odds(pack_log_odds(values))
    np.testing.assert_allclose(found[:5], values[:5], atol=0.002)
    assert found[5] == found[8] == -found[6] == pytest.approx(127.996, abs=0.001)
    assert np.isnan(found[7])


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
    one, both = Catalogue(runs[:1]), Catalogue(runs)
    assert one.stamp("run/run") == both.stamp("run/run") != both.stamp("other/run")
    assert one.stamp("index") != both.stamp("index")
    assert json.dumps(one.stamp("run/e/00000")) != json.dumps(one.stamp("run/e/00001"))


@pytest.mark.slow
def test_later_inferences_are_read_by_the_fold_that_tests_the_item_and_by_probes_of_their_own(
    runs: list[Run],
) -> None:
    catalogue, results = Catalogue(runs[:1]), load_results(runs[0])
    own = {call: found.curves["color", "mean"] for call, found in load_results_by_call(runs[0], results).items()}
    curve = own[0]
    features = {site: [runs[0].column(site, call=call) for call in range(2)] for site in curve.sites}
    for position, number in enumerate(runs[0].episodes["episode"]):
        found = payload(catalogue, f"a/e/{number:05d}")
        at = curve.episodes.tolist().index(runs[0].episodes["episode_id"].iloc[position])
        sign = 1 if curve.labels[at] else -1
        frozen, refitted = (log_odds(found[name]).reshape(2, -1) for name in ("log_odds", "refitted"))
        for place, site in enumerate(curve.sites):
            probe = results.direction("color", "mean", site)
            weights, intercept = (
                probe.weights[curve.fold_of[at]].astype(float),
                probe.intercepts[curve.fold_of[at]],
            )
            expected = [sign * (features[site][call][position] @ weights + intercept) for call in range(2)]
            np.testing.assert_allclose(frozen[:, place], expected, atol=0.003)
            stored = [sign * own[call].decisions[place, own[call].episodes.tolist().index(curve.episodes[at])]
                      for call in range(2)]  # fmt: skip
            np.testing.assert_allclose(refitted[:, place], stored, atol=0.003)


def test_a_model_that_was_asked_is_shown_with_question_and_answers_in_words(
    small_suite: Suite, tmp_path: Path
) -> None:
    plan = little_plan(small_suite.select(["color"]), 0, 2)
    settings = {**little_settings(), "ask": ASK}
    writer = RunWriter(locate(tmp_path / "run"), plan, settings)
    certify(writer)
    asked = {"question": "Which one?\nA left\nB right", "answer": "Neither <b>", "said": "none", "parse": "none"}
    outcomes = {"outcome": "oob", "outcome_logits": "correct", "outcome_debiased": "wrong"}
    sides = {"side_placed": "none", "side_logits": "left", "side_debiased": "right"}
    measured = {"parse_tier": "none", "letter_bias": 0.1, "content": 1.0, "margin": 1.0, "option_mass": 0.9}
    marks = {"near_tie": False, "side_word": False}
    for number in range(2):
        record = episode(plan, number)
        said = {**asked, **outcomes, **sides, **measured, **marks}
        writer.write(replace(record, outcome={**record.outcome, **said}))
    catalogue = Catalogue([open_run(tmp_path / "run", allow_partial=True)])
    assert payload(catalogue, "run/e/00000")["words"] == {
        "question": asked["question"], "text": "Neither <b>", "option read": "none", "parsing rule": "none",
        "outcome, text": "unread", "outcome, logits": "correct", "outcome, order-balanced": "wrong",
    }  # fmt: skip
    assert words(payload(catalogue, "run/episodes")["outcome"]) == ["unread", "unread"]
