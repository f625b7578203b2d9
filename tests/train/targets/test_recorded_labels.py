"""Labels on runs of recordings: columns of the data set, controls from the stored inputs, groups that exchange."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from probe_kit.errors import UsageError
from probe_kit.runs import Run, open_run
from probe_kit.train import Controls, ProbeResults, Target, train_probes
from probe_kit.train.columns.builtin import label_frame
from probe_kit.train.controls.features import small_pictures, step_features
from probe_kit.train.controls.fit import PreparedControls, prepare_controls
from probe_kit.train.data.samples import read_samples
from probe_kit.train.target_samples import TargetSamples, target_samples
from tests.support.recorded_run import CALLS, EVERY, PLANTED, write_recorded_run


@pytest.fixture(scope="module")
def results(shown_run: Run) -> ProbeResults:
    labels = Target.of_run(shown_run, "dataset.state.x")
    return train_probes(shown_run, target=labels, permutations=39, controls=("state", "instruction"))


def prepared_of(run: Run, samples: TargetSamples, names: tuple[str, ...] | None = None) -> PreparedControls:
    return prepare_controls(run, samples, False, names, None, Controls(), ("all",))


def samples_of(run: Run, target: str = "dataset.state.x") -> TargetSamples:
    return target_samples(run, Target.of_run(run, target), None, 0, None)


def test_a_number_of_the_state_is_a_label_and_what_the_state_says_alone_is_no_signal(
    results: ProbeResults,
) -> None:
    """Planted at one site: found there; but the recorded state says it too, so no signal."""
    scores = results.scores.set_index("site")
    best = scores.loc["backbone.01.residual"]
    assert results.settings.task == "continuous"
    assert best["score"] > 0.9
    assert best["p_fwe"] < 0.05
    assert scores.loc["backbone.00.residual", "p_fwe"] > 0.05
    assert best["exceeds_instruction"]
    assert not best["exceeds_state"]
    assert not best["signal"]


def test_groups_are_recorded_episodes_and_exchange_as_wholes(shown_run: Run, results: ProbeResults) -> None:
    assert set(results.curves["all", "mean"].groups) == set(shown_run.episodes["item_id"][:-1]), (
        "the short one is left out of the window"
    )
    assert results.left_out == {"episodes that end before inference 3": 1}
    assert results.settings.group_by == "group_id"
    assert results.settings.suite == shown_run.suite


def test_the_controls_are_made_of_what_was_shown(shown_run: Run) -> None:
    samples = samples_of(shown_run)
    prepared = prepared_of(shown_run, samples)
    names, inputs, left_out = prepared.names, prepared.inputs, prepared.left_out
    assert names == ("step", "state", "instruction", "random-features", "pixels")
    assert not left_out
    assert shown_run.inputs is not None
    expected = shown_run.inputs.read("state")[samples.rows, samples.inferences]
    np.testing.assert_array_equal(inputs.features("state"), expected)
    assert inputs.features("pixels").shape == (samples.rows.size, 32 * 32 * 3)
    np.testing.assert_allclose(
        inputs.features("pixels")[0], shown_run.inputs.read("pixels")[0, 0].ravel() / 255, rtol=1e-6
    )
    actions = shown_run.inputs.read("action")[samples.rows, samples.inferences]
    np.testing.assert_array_equal(inputs.features("action"), actions[:, 0])
    assert prepared_of(shown_run, samples, ("action",)).names == ("action",), "offered, not run by default"
    step = inputs.features("step")
    np.testing.assert_array_equal(step.argmax(axis=1), samples.inferences)
    assert inputs.layer(np.arange(samples.rows.size), 6, 0).shape == (samples.rows.size, 6)


def test_the_step_of_recordings_is_the_frame_and_not_the_place_in_its_row() -> None:
    """The second stretch of a long episode begins at frame 64, not at inference 0."""
    samples = TargetSamples(
        np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.zeros(4), np.full(4, "a"), np.full(4, "all"), 2, {}
    )
    found = step_features(samples, np.array([0, 1, 2, 3]))
    np.testing.assert_array_equal(found, np.eye(4))


def test_small_pictures_are_means_of_the_stored_ones() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (2, 1, 32, 32, 3), dtype=np.uint8)
    found = small_pictures(pixels, 16).reshape(2, 16, 16, 3)
    expected = pixels[:, 0].reshape(2, 16, 2, 16, 2, 3).mean(axis=(2, 4)) / 255
    np.testing.assert_allclose(found, expected, atol=1.01 / 255)


def test_a_run_without_pixels_says_why_two_controls_are_left_out(tmp_path: Path) -> None:
    run = write_recorded_run(tmp_path / "run", 6, pixels=False)
    prepared = prepared_of(run, samples_of(run))
    assert prepared.names == ("step", "state", "instruction")
    assert set(prepared.left_out) == {"pixels", "random-features"}
    with pytest.raises(UsageError, match="'pixels' is not possible: the run was extracted with --no-pixels"):
        prepared_of(run, samples_of(run), ("pixels",))


def test_the_table_to_be_extended_has_source_frames_and_the_columns_of_the_data_set(shown_run: Run) -> None:
    table = label_frame(shown_run)
    assert len(table) == 12 * CALLS - 1
    assert list(table["frame"][:CALLS]) == [EVERY * call for call in range(CALLS)]
    assert set(table["source_episode"]) == set(range(12))
    assert {"dataset.timestamp", "dataset.next.reward", "dataset.state.x", "dataset.action.grip"} <= set(table)
    assert not [name for name in table if str(name).startswith(("sim.", "item."))]
    labels = Target.read(table.assign(mine=range(len(table))), "mine", task="continuous")
    assert np.isfinite(labels.coded.values).all()


def test_features_and_label_of_one_frame_belong_together(shown_run: Run) -> None:
    samples = samples_of(shown_run)
    site = shown_run.sites("backbone")[1]
    features = read_samples(shown_run, "mean", site, samples.rows, samples.inferences).features
    np.testing.assert_allclose(features[:, PLANTED], 5 * samples.values, rtol=1e-5)


def test_a_column_that_the_data_set_lacks_is_named_with_those_it_has(shown_run: Run, labelled_run: Path) -> None:
    with pytest.raises(UsageError, match=r"no column dataset\.next\.done; there are: dataset\.timestamp"):
        Target.of_run(shown_run, "dataset.next.done")
    with pytest.raises(UsageError, match="none, because the run is not of recordings"):
        Target.of_run(open_run(labelled_run), "dataset.next.done")


def test_fewer_than_five_recorded_episodes_are_refused(tmp_path: Path) -> None:
    run = write_recorded_run(tmp_path / "run", 4)
    with pytest.raises(Exception, match=r"4 groups \(group_id\) have labels; expected at least 5"):
        train_probes(run, target=Target.of_run(run, "dataset.state.x"))


def test_groups_that_split_a_recorded_episode_are_refused(shown_run: Run) -> None:
    table = label_frame(shown_run)
    table["mine"] = np.arange(len(table), dtype=float)
    table["half"] = pd.Series(table["inference"] % 2).astype(str)
    with pytest.raises(UsageError, match="expected one value"):
        train_probes(shown_run, target=Target.read(table, "mine", task="continuous", group_by="half"))


def source_table() -> pd.DataFrame:
    """A table as a user has it of the data set: every frame of 14 episodes, of which the run shows 12."""
    frames = [(episode, frame) for episode in range(14) for frame in range(20)]
    table = pd.DataFrame(frames, columns=["source_episode", "frame"])
    return table.assign(mine=np.random.default_rng(0).normal(size=len(table)), even=table["frame"] % 2 == 0)


def test_labels_have_the_numbers_of_the_data_set_as_keys(shown_run: Run) -> None:
    """Of 280 labelled frames the run shows 47; the others are left out and counted."""
    table = source_table()
    samples = target_samples(shown_run, Target.read(table, "mine"), None, 0, None)
    assert samples.left_out["labels of frames or episodes that the run does not show"] == 280 - 47
    expected = {(row.source_episode, row.frame): row.mine for row in table.itertuples()}
    steps = shown_run.control_steps[samples.rows, samples.inferences]
    assert [expected[key] for key in zip(samples.rows, steps, strict=True)] == samples.values.tolist()


def test_labels_of_whole_source_episodes_are_those_of_their_rows(shown_run: Run) -> None:
    table = pd.DataFrame(
        {"source_episode": range(14), "kind": [f"k{number % 3}" for number in range(12)] + ["x", "x"]}
    )
    labels = Target.read(table, "kind")
    assert labels.coded.classes == ("k0", "k1", "k2", "x")
    samples = target_samples(shown_run, labels, None, 0, None)
    np.testing.assert_array_equal(samples.values, np.arange(12) % 3)
    assert labels.on(shown_run).coded.classes == ("k0", "k1", "k2"), "no episode of the run is an x"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame": 1}, r"column 'frame' is 20; episode 0 of the data set of .* has 20 frames, counted from 0"),
        ({"source_episode": 1}, r"column 'source_episode' is 14; the data set of .* has 14 episodes"),
    ],
)
def test_frames_and_episodes_that_were_never_recorded_are_refused_by_their_line(
    shown_run: Run, change: dict[str, int], message: str
) -> None:
    """Unlike those that the run does not show: the table counts from 1, and every label is one off."""
    table = source_table()
    for column, by in change.items():
        table[column] += by
    with pytest.raises(UsageError, match=message):
        target_samples(shown_run, Target.read(table, "mine"), None, 0, None)
    if "source_episode" in change:
        whole = table.groupby("source_episode", as_index=False)["mine"].first()
        with pytest.raises(UsageError, match=message):
            Target.read(whole, "mine").on(shown_run)


def test_keys_of_recordings_are_refused_on_scenes_and_where_nothing_is_shown(
    shown_run: Run, labelled_run: Path
) -> None:
    table = source_table()
    with pytest.raises(UsageError, match=r"is of scenes; expected 'episode_id'"):
        target_samples(open_run(labelled_run), Target.read(table, "mine"), None, 0, None)
    with pytest.raises(UsageError, match="no label of a frame that"):
        target_samples(shown_run, Target.read(table[table["frame"] == 3], "mine"), None, 0, None)
    with pytest.raises(UsageError, match=r"column 'frame' is 0\.5; expected the number of a frame, from 0"):
        Target.read(table.assign(frame=0.5), "mine")
