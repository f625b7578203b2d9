"""`probe-kit extract` and `ask` in the scene, and what their runs offer in Python."""

from pathlib import Path

import numpy as np
import pytest

import probe_kit as pk
from tests.acceptance.conftest import PLAYED
from tests.acceptance.product import probe_kit

LAST = pk.Site("backbone", 3)
FEW = ("--categories", "color", "--items", "2", "--env-workers", "0")


def test_a_played_run_holds_every_episode_with_its_question_its_outcome_and_its_seeds(run: pk.Run) -> None:
    episodes = run.episodes
    assert len(episodes) == 24
    assert set(episodes["category"]) == {"color"}
    assert episodes["episode_id"].is_unique
    layouts = episodes.groupby("item_id")
    assert (layouts.size() == 2).all()
    assert (layouts["side_correct"].nunique() == 2).all()
    assert episodes["outcome"].isin(["correct", "wrong", "oob"]).all()
    assert episodes["instruction"].str.contains("cube").all()
    placed = episodes["side_placed"].where(episodes["outcome"] != "oob", episodes["side_correct"])
    correct = episodes["outcome"] == "correct"
    assert (correct[episodes["outcome"] != "oob"] == (placed == episodes["side_correct"])).all()
    assert correct.mean() > 0.5, "the embedded policy acts on Color"
    assert episodes["steps"].between(1, 6).all()


def test_its_streams_views_and_columns_have_the_shapes_that_they_declare(run: pk.Run) -> None:
    assert set(run.streams) == {"backbone", "expert"}
    assert run.streams["backbone"].iterations is None
    for name, stream in run.streams.items():
        assert {"mean", "last"} <= set(run.views(name))
        for view in run.views(name):
            for iteration in (None,) if stream.iterations is None else (0, stream.iterations - 1):
                for layer in range(stream.layers):
                    column = run.column(pk.Site(name, layer, iteration=iteration), view)
                    assert column.shape == (24, stream.width)
                    assert column.dtype == np.float32
                    assert np.isfinite(column).all()
    assert not np.array_equal(run.column(LAST, "mean"), run.column(LAST, "mean:language"))
    first, second = run.column(LAST, "mean", 0), run.column(LAST, "mean", 1)
    assert np.isfinite(second).all()
    assert not np.array_equal(first, second)


def test_stored_tokens_are_those_that_the_pooled_views_are_means_of(run: pk.Run) -> None:
    values, mask = run.tokens(LAST, "language")
    assert values.shape[:2] == mask.shape == (24, values.shape[1])
    assert mask.any(axis=1).all()
    counts = mask.sum(axis=1)[:, None]
    means, sizes = (np.where(mask[..., None], part, 0).sum(axis=1) / counts for part in (values, np.abs(values)))
    away = np.abs(means - run.column(LAST, "mean:language"))
    assert (away <= 2**-8 * sizes + 1e-4).all(), "bfloat16 rounds each token by 2^-9 of its size"


@pytest.mark.slow
def test_the_same_settings_give_the_same_numbers_in_another_folder(run: pk.Run, tmp_path: Path) -> None:
    words = dict(zip(PLAYED[::2], PLAYED[1::2], strict=True)) | {"--items": "2"}
    typed = [word for pair in words.items() for word in pair]
    printed = probe_kit("extract", *typed, "--out", tmp_path / "again")
    assert "again" in printed.text
    again = pk.open_run(tmp_path / "again").episodes.set_index("episode_id")
    first = run.episodes.set_index("episode_id").loc[again.index]
    assert len(again) == 4
    assert (first["outcome"] == again["outcome"]).all()
    assert (first[["cube_x", "cube_y"]] == again[["cube_x", "cube_y"]]).to_numpy().all()
    rows = run.episodes["episode_id"].isin(again.index).to_numpy()
    order = [list(again.index).index(name) for name in run.episodes["episode_id"][rows]]
    for site in (LAST, pk.Site("expert", 3, iteration=9)):
        repeated = pk.open_run(tmp_path / "again").column(site, "mean")
        assert np.array_equal(run.column(site, "mean")[rows], repeated[order])


def test_a_command_typed_again_plays_nothing_and_other_settings_in_its_folder_are_refused(
    played: Path, run: pk.Run
) -> None:
    before = run.column(LAST, "mean")
    probe_kit("extract", *PLAYED, "--out", played)
    assert np.array_equal(pk.open_run(played).column(LAST, "mean"), before)
    refused = probe_kit("extract", *PLAYED, "--seed", "1", "--out", played, code=3)
    assert "seed" in refused.text


@pytest.mark.slow
def test_a_captured_run_has_activations_of_the_same_first_frames_and_no_success_rate(
    run: pk.Run, tmp_path: Path
) -> None:
    probe_kit("extract", "--model", "pi0-tiny", *FEW, "--no-act", "--out", tmp_path / "captured")
    captured = pk.open_run(tmp_path / "captured")
    assert captured.capture_only
    assert not run.capture_only
    assert not captured.episodes["outcome"].isin(["correct", "wrong", "oob"]).any()
    rows = [list(run.episodes["episode_id"]).index(name) for name in captured.episodes["episode_id"]]
    assert np.array_equal(captured.column(LAST, "mean"), run.column(LAST, "mean")[rows])


@pytest.mark.slow
def test_asking_stores_the_answers_to_the_same_first_frames(run: pk.Run, tmp_path: Path) -> None:
    asked = probe_kit("ask", "--model", "vlm-tiny", *FEW, "--prompt", "p1,seen", "--out", tmp_path / "asked")
    folders = sorted(path for path in (tmp_path / "asked").iterdir() if path.is_dir())
    assert len(folders) == 2, "a run per prompt"
    assert "p1" in asked.text
    played = run.episodes.set_index("episode_id")
    for folder in folders:
        answers = pk.open_run(folder).episodes.set_index("episode_id")
        assert len(answers) == 4
        assert answers["outcome"].isin(["correct", "wrong", "oob"]).all()
        assert answers["said"].str.len().gt(0).all()
        assert answers["question"].str.contains("shape").all()
        assert answers["option_mass"].between(0, 1).all()
        same = played.loc[answers.index, "first_frame_sha256"]
        assert (same == answers["first_frame_sha256"]).all()


@pytest.mark.parametrize(
    ("words", "code", "named"),
    [
        (("--model", "pi0-tny"), 2, "pi0-tiny"),
        (("--model", "pi0-tiny", "--categories", "colour"), 2, "color"),
        (("--model", "pi0-tiny", "--categories", "color", "--items", "3"), 2, "even"),
    ],
)
def test_a_wrong_setting_is_named_with_what_is_possible_and_nothing_is_left(
    words: tuple[str, ...], code: int, named: str, tmp_path: Path
) -> None:
    refused = probe_kit("extract", *words, "--out", tmp_path / "run", code=code)
    assert named in refused.text
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_prints_the_plan_and_writes_nothing(tmp_path: Path) -> None:
    plan = probe_kit("extract", "--model", "pi0", *FEW, "--dry-run", "--out", tmp_path / "x")
    assert "expert" in plan.text
    assert "episodes" in plan.text
    assert list(tmp_path.iterdir()) == []
