"""Sweeps of targets that are no side: windows, events, groups, and recordings."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import NoProbesError, TooFewGroupsError, UnknownCategoryError, UsageError
from probe_kit.runs import Run, open_run
from probe_kit.suite import Suite
from probe_kit.train import Controls, ProbeResults, Target, load_results, train_probes
from probe_kit.train.builtin_columns import label_frame
from probe_kit.train.control_features import small_pictures, step_features
from probe_kit.train.controls import PreparedControls, prepare_controls
from probe_kit.train.problem import make_problem
from probe_kit.train.samples import read_samples
from probe_kit.train.target_samples import TargetSamples, target_samples
from tests.support.labelled_run import CALLS
from tests.support.recorded_run import CALLS as SHOWN_CALLS
from tests.support.recorded_run import EVERY, PLANTED, write_recorded_run
from tests.train.conftest import settings_of

QUICK = {"permutations": 59, "controls": ()}


@pytest.fixture
def run(labelled_run: Path, tmp_path: Path) -> Run:
    """A copy, so that what a test stores stays its own."""
    shutil.copytree(labelled_run, tmp_path / "run")
    return open_run(tmp_path / "run")


def by_group(run: Run, values: Callable[[np.random.Generator], float | str | int]) -> pd.DataFrame:
    """A label per episode, the same in a group."""
    draw = np.random.default_rng(0)
    groups = {name: values(draw) for name in dict.fromkeys(run.episodes["group_id"])}
    return pd.DataFrame({"episode_id": run.episodes["episode_id"], "y": run.episodes["group_id"].map(groups)})


def test_a_planted_quantity_is_found_where_it_was_planted_and_is_no_signal_beyond_the_state(run: Run) -> None:
    labels = Target.of_run(run, "sim.tool_y")
    results = train_probes(run, target=labels, permutations=59, controls=("step", "state", "instruction"))
    scores = results.scores.set_index("site")
    planted = scores.loc["backbone.01.residual"]
    assert planted["score"] > 0.95
    assert planted["p_fwe"] == planted["smallest_p"] == 1 / 60
    assert planted["ci_low"] < planted["score"] < planted["ci_high"] <= 1
    assert planted["spearman"] > 0.9
    other_scores = scores.drop("backbone.01.residual")
    assert (other_scores["score"] < 0.3).all()
    assert planted["exceeds_step"]
    assert planted["exceeds_instruction"]
    assert not planted["exceeds_state"], "the state holds the hand itself"
    assert not planted["signal"]
    assert planted["best_control"] > 0.99
    assert results.left_out == {f"episodes that end before inference {CALLS - 1}": 1}
    assert planted["n"] == CALLS * planted["episodes"] == CALLS * (len(run.episodes) - 1)


@pytest.mark.slow
def test_without_a_control_that_explains_it_a_planted_quantity_is_a_signal(run: Run) -> None:
    labels = Target.of_run(run, "sim.tool_y")
    results = train_probes(run, target=labels, permutations=59, controls=("step", "instruction"))
    signal = results.scores.set_index("site")["signal"]
    assert signal[signal].index.tolist() == ["backbone.01.residual"]


@pytest.mark.slow
def test_stored_probes_are_loaded_and_controls_are_added_without_a_second_fit(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    labels = Target.of_run(run, "sim.tool_y")
    first = train_probes(run, target=labels, **QUICK)
    assert first.controls.names == ()
    monkeypatch.setattr("probe_kit.train.probe_sweep.probe_columns", None)
    second = train_probes(run, target=labels, permutations=59, controls=("step",))
    assert second.key == first.key
    assert second.controls.names == ("step",)
    for loaded in (
        load_results(run, target="sim.tool_y"),
        load_results(run, first.key[:5]),
        train_probes(run, target=labels, **QUICK),
    ):
        pd.testing.assert_frame_equal(loaded.scores, second.scores)
        curve, other = (results.curves["all", "mean"] for results in (loaded, second))
        for name in ("labels", "episodes", "inferences", "groups", "fold_of"):
            assert (getattr(curve, name) == getattr(other, name)).all()
    assert CliRunner().invoke(app, ["run", "verify", "--deep", str(run.location)]).exit_code == 0
    output = CliRunner().invoke(app, ["run", "show", str(run.location)]).stdout
    assert f"probes {first.key}" in output
    assert "of a label of your own" in " ".join(output.split())
    assert "target sim.tool_y (continuous)" in " ".join(output.split())


def test_probes_of_sides_keep_key_and_bytes_and_neither_kind_reads_the_other(run: Run) -> None:
    sides = train_probes(run, permutations=3, controls=())
    before = {file.name: file.read_bytes() for file in (run.path / "probes" / sides.key).iterdir()}
    label = train_probes(run, target=Target.of_run(run, "sim.tool_y"), **QUICK)
    assert {file.name: file.read_bytes() for file in (run.path / "probes" / sides.key).iterdir()} == before
    assert load_results(run).key == sides.key
    assert load_results(run, target="sim.tool_y").key == label.key
    assert load_results(run, label.key).settings.task == "continuous"
    with pytest.raises(UsageError, match=r"are of 'sim\.tool_y', not of 'side.correct'"):
        load_results(run, label.key, "side.correct")
    with pytest.raises(NoProbesError, match=r"no probes for target 'other'.*--target other"):
        load_results(run, target="other")


@pytest.mark.slow
def test_another_value_group_stratum_or_window_is_another_key(run: Run) -> None:
    frame = by_group(run, lambda draw: float(draw.normal()))
    frame["half"] = run.episodes["group_id"].map(lambda name: int(name[-1], 16) % 2)
    other = frame.assign(y=frame["y"] + 1)

    def key(table: pd.DataFrame, **options: str) -> str:
        results = train_probes(run, target=Target.read(table, "y", **options), permutations=0, controls=())  # type: ignore[arg-type]
        return results.key

    first = key(frame)
    assert key(frame.iloc[::-1]) == first
    assert len({first, key(other), key(frame, exchange_within="half")}) == 3


def test_step_and_group_labels_of_the_run_have_the_null_that_keeps_them(run: Run) -> None:
    labels = Target.of_run(run, "sim.steps_to_grasp")
    with pytest.warns(UserWarning, match="the same in every group"):
        results = train_probes(run, target=labels, permutations=59, controls=("step",))
    assert (results.scores["p"] == 1).all(), "every group has the same steps, so nothing can be shown"
    assert results.controls.scores[0].score > 0.99
    assert not results.scores["signal"].any()


@pytest.mark.slow
def test_classes_with_a_planted_site_are_found(run: Run, small_suite: Suite) -> None:
    y = np.stack([run.trajectory(row).tool[0, 1] for row in range(len(run.episodes))])
    names = np.array(["low", "middle", "high"])[np.digitize(y, np.quantile(y, [1 / 3, 2 / 3]))]
    table = pd.DataFrame({"episode_id": run.episodes["episode_id"], "y": names})
    labels = Target.read(table, "y")
    results = train_probes(run, target=labels, permutations=59, suite=small_suite.folder)
    assert results.curves["all", "mean"].classes == ("high", "low", "middle")
    best = results.scores.loc[results.scores["score"].idxmax()]
    assert best["site"] == "backbone.01.residual"
    assert best["score"] > 0.6
    assert results.controls.names == ("state", "instruction", "random-features", "pixels")
    assert set(results.controls.left_out) == {"step"}


def samples_of(run: Run, table: pd.DataFrame, **options: object) -> object:
    task = options.pop("task", None)
    names = {name: options.pop(name, None) for name in ("group_by", "exchange_within")}
    labels = Target.read(table, "y", task=task, **names)  # type: ignore[arg-type]
    return target_samples(run, labels, options.get("categories"), options.get("call", 0), options.get("window"))  # type: ignore[arg-type]


def test_keys_and_groups_that_the_run_does_not_have_are_refused_with_their_row(run: Run) -> None:
    frame = by_group(run, lambda draw: float(draw.normal()))
    strange = pd.concat([frame, pd.DataFrame({"episode_id": ["none"], "y": [0.5]})])
    with pytest.raises(UsageError, match=rf"DataFrame, row {len(frame) + 1}: .* has no episode 'none'"):
        samples_of(run, strange)
    late = frame.assign(inference=CALLS)
    with pytest.raises(UsageError, match=rf"row 1: episode .* has {CALLS} captured .*there is no {CALLS}"):
        samples_of(run, late)
    with pytest.raises(UsageError, match=r"have a column 'scene'; the episodes have"):
        samples_of(run, frame, group_by="scene")
    with pytest.raises(UsageError, match=r"--group-by episode_id separates items that share a picture"):
        samples_of(run, frame, group_by="episode_id")
    with pytest.raises(UsageError, match=r"--exchange-within layout splits a group"):
        samples_of(run, frame, exchange_within="layout")
    steps = pd.concat([frame.assign(inference=call, scene=f"s{call}") for call in range(2)])
    with pytest.raises(UsageError, match=r"column 'scene': episode .* is in 's1', and in 's0' in row 1"):
        samples_of(run, steps, group_by="scene")
    with pytest.raises(UsageError, match=r"window=5; expected 1 to 4"):
        samples_of(run, steps, window=5)
    with pytest.raises(UsageError, match=r"call=1 with .* which has a label for every inference"):
        samples_of(run, steps, call=1)
    with pytest.raises(UsageError, match=r"window=2 with .*, a label per episode"):
        samples_of(run, frame, window=2)


def test_too_few_groups_rare_classes_and_unknown_options_are_refused_before_any_fit(run: Run) -> None:
    frame = by_group(run, lambda draw: float(draw.normal()))
    few = frame[frame["episode_id"].isin(run.episodes["episode_id"][:6])]
    with pytest.raises(TooFewGroupsError, match=r"groups \(group_id\) have labels; expected at least 5"):
        train_probes(run, target=Target.read(few, "y", task="continuous"), **QUICK)
    rare = frame.assign(y=np.where(run.episodes["group_id"] == run.episodes["group_id"].iloc[0], "rare", "common"))
    with pytest.raises(TooFewGroupsError, match=r"class 'rare' is in 1 of \d+ groups"):
        train_probes(run, target=Target.read(rare, "y"), **QUICK)
    labels = Target.read(frame, "y")
    with pytest.raises(UsageError, match="unknown control 'luck'; expected some of position, step, state"):
        train_probes(run, target=labels, controls=("luck",))
    with pytest.raises(UsageError, match="control 'step' is not possible"):
        train_probes(run, target=labels, controls=("step",))
    with pytest.raises(UnknownCategoryError):
        train_probes(run, ("texture",), target=labels)
    with pytest.raises(UsageError, match=r"window=2 with the side 'side\.correct'"):
        train_probes(run, window=2)
    with pytest.raises(UsageError, match=r"device 'cpu' with .* ridge is solved by numpy"):
        train_probes(run, target=labels, device="cpu")
    with pytest.raises(UsageError, match=r"folds='concepts' with columns of groups \(layout\)"):
        train_probes(run, target=Target.read(frame, "y", group_by="layout"), folds="concepts")


def test_groups_that_cannot_exchange_have_scores_and_no_p(run: Run) -> None:
    frame = by_group(run, lambda draw: float(draw.normal()))
    with pytest.warns(UserWarning, match=r"0 % of the samples are in groups that have another one"):
        results = train_probes(
            run, target=Target.read(frame, "y", exchange_within="group_id"), permutations=19, controls=()
        )
    assert results.scores["p_fwe"].isna().all()
    assert not results.scores["signal"].any()


def test_a_column_of_a_table_may_be_called_as_a_side_is_without_its_prefix(run: Run) -> None:
    frame = by_group(run, lambda draw: float(draw.normal())).rename(columns={"y": "correct"})
    results = train_probes(run, target=Target.read(frame, "correct"), permutations=1, controls=())
    assert not results.settings.balanced
    assert load_results(run, target="correct").key == results.key


def test_the_command_prints_one_table_and_a_sentence(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "own.csv"
    by_group(run, lambda draw: float(draw.normal())).to_csv(file, index=False)
    options = ["--permutations", "9", "--controls", "instruction"]
    result = CliRunner().invoke(
        app, ["train", str(run.location), "--labels", str(file), "--target", "y", *options], env={"COLUMNS": "100"}
    )
    assert result.exit_code == 0, result.stderr
    assert "y not testable in the backbone and the action expert: train with --permutations" in " ".join(
        result.stdout.split()
    )
    assert f"y (continuous), {len(run.episodes)} numbers" in result.stdout
    assert "control instruction" in result.stdout
    assert result.stdout.splitlines()[0] == Target.read(file, "y").contents
    assert load_results(run, target="y").settings.target == "y"


@pytest.mark.slow
def test_the_command_prints_the_classes_once_with_their_counts(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "own.csv"
    by_group(run, lambda draw: str(draw.choice(["Yes", "no"]))).to_csv(file, index=False)
    lines = file.read_text(encoding="utf-8").splitlines()
    lines[1] = lines[1].rpartition(",")[0] + ",NA"
    file.write_text("\n".join(lines), encoding="utf-8")
    options = ["--labels", str(file), "--target", "y", "--permutations", "0", "--controls", "instruction"]
    result = CliRunner().invoke(app, ["train", str(run.location), *options], env={"COLUMNS": "100"})
    assert result.exit_code == 0, result.stderr
    counts = {word: sum(line.endswith(f",{word}") for line in lines) for word in ("no", "Yes")}
    line = f"y (binary), 2 classes: no {counts['no']}, yes {counts['Yes']}; 1 missing"
    assert result.stdout.splitlines().count(line) == 1


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--target", "y"], "nor a built-in column (sim.tool_x"),
        (["--target", "side.chosen", "--labels", "own.csv"], "--target side.chosen is a side"),
        (["--task", "binary"], "--task is for labels of your own"),
        (["--window", "3"], "--window is for labels of your own"),
        (["--target", "sim.held", "--call", "1"], "call=1 with the built-in column 'sim.held'"),
        (["--target", "item.named", "--call", "x"], "--call 'x'; expected numbers from 0"),
    ],
)
def test_options_that_contradict_each_other_are_refused(
    labelled_run: Path, options: list[str], expected: str
) -> None:
    result = CliRunner().invoke(app, ["train", str(labelled_run), *options])
    assert result.exit_code == 2
    assert expected in str(result.exception) or expected in result.stderr


GRASPED = 2
"""The inference at frame 6 is the first at which the cube is held."""


@pytest.fixture(scope="module")
def events_run(labelled_run: Path) -> Run:
    return open_run(labelled_run)


def table_of(events_run: Run) -> pd.DataFrame:
    """An event at inference 0, 1 or 2 of each episode in turn; the label is the number of inferences since."""
    rows = [
        {"episode_id": name, "inference": call, "open": call >= number % 3, "since": float(call - number % 3)}
        for number, name in enumerate(events_run.episodes["episode_id"])
        for call in range(CALLS if number + 1 < len(events_run.episodes) else 2)
    ]
    return pd.DataFrame(rows)


def test_a_window_begins_where_the_cube_is_first_held(events_run: Run) -> None:
    labels, event = Target.of_run(events_run, "sim.tool_y"), Target.of_run(events_run, "sim.held")
    samples = target_samples(events_run, labels, None, 0, None, event)
    assert samples.window == CALLS - GRASPED
    assert set(samples.inferences.tolist()) == {GRASPED, GRASPED + 1}
    assert samples.left_out == {
        "episodes in which sim.held is never true": 1,
        "labels outside the window of 2": GRASPED * (len(events_run.episodes) - 1),
    }
    expected = [
        events_run.trajectory(int(row)).tool[3 * call, 1]
        for row, call in zip(samples.rows, samples.inferences, strict=True)
    ]
    np.testing.assert_allclose(samples.values, expected, rtol=1e-6)
    features = read_samples(
        events_run, "mean", events_run.sites("backbone")[1], samples.rows, samples.inferences
    ).features
    np.testing.assert_allclose(features[:, 3], 10 * samples.values, rtol=1e-5)


def test_an_event_may_be_a_value_of_a_column_of_classes(events_run: Run) -> None:
    phase = Target.of_run(events_run, "sim.phase")
    samples = target_samples(
        events_run, Target.of_run(events_run, "sim.tool_y"), None, 0, None, phase.equal_to("after release")
    )
    assert (samples.window, set(samples.inferences.tolist())) == (1, {3})
    assert samples.left_out == {
        "episodes in which sim.phase=after release is never true": 1,
        "labels outside the window of 1": 3 * (len(events_run.episodes) - 1),
    }
    with pytest.raises(UsageError, match="no value 'landed'; it has after release, before grasp, holding"):
        phase.equal_to("landed")
    with pytest.raises(UsageError, match="quantities, not classes"):
        Target.of_run(events_run, "sim.tool_y").equal_to("0")


def test_inferences_correspond_by_their_place_behind_the_event(events_run: Run) -> None:
    table = table_of(events_run)
    labels, event = Target.read(table, "since", "continuous"), Target.read(table, "open")
    samples = target_samples(events_run, labels, None, 0, 2, event)
    assert (samples.values == samples.steps).all()
    assert set(samples.inferences.tolist()) == {0, 1, 2, 3}
    assert (step_features(samples).argmax(axis=1) == samples.steps).all()
    with pytest.warns(UserWarning, match="the same in every group"):
        problem = make_problem(events_run, labels, samples, "all", settings_of(19))
    columns = np.column_stack([problem.labels, problem.permuted_labels])
    assert (columns == samples.steps[:, None]).all(), "labels of one place stay at that place"


def test_episodes_that_end_too_soon_behind_the_event_are_left_out(events_run: Run) -> None:
    table = table_of(events_run)
    labels, event = Target.read(table, "since", "continuous"), Target.read(table, "open")
    samples = target_samples(events_run, labels, None, 0, 3, event)
    late = sum(number % 3 == 2 for number in range(len(events_run.episodes) - 1))
    assert samples.left_out["episodes that end within 3 inferences of it"] >= late
    assert np.bincount(samples.rows)[np.unique(samples.rows)].tolist() == [3] * np.unique(samples.rows).size


def test_an_alignment_to_a_column_that_is_no_event_is_refused(events_run: Run) -> None:
    table = table_of(events_run)
    labels = Target.read(table, "since", "continuous")
    with pytest.raises(UsageError, match=r"'since' .*aligned to .*sim.phase.*expected .* true and false"):
        target_samples(events_run, labels, None, 0, None, Target.of_run(events_run, "sim.phase"))
    with pytest.raises(UsageError, match="expected labels per inference"):
        target_samples(
            events_run, Target.of_run(events_run, "item.named"), None, 0, None, Target.read(table, "open")
        )
    result = CliRunner().invoke(app, ["train", str(events_run.path), "--align-to", "sim.held"])
    assert "--align-to is for labels of your own" in " ".join(result.stderr.split())


@pytest.mark.slow
def test_the_event_is_part_of_the_results_key(events_run: Run, tmp_path: Path) -> None:
    copy = open_run(shutil.copytree(events_run.path, tmp_path / "run"))
    labels, event = Target.of_run(copy, "sim.tool_y"), Target.of_run(copy, "sim.held")
    plain = train_probes(copy, target=labels, permutations=0, controls=(), window=2)
    aligned = train_probes(copy, target=labels, permutations=0, controls=(), window=2, align_to=event)
    assert plain.key != aligned.key
    assert plain.settings.align_to == ""
    assert aligned.settings.align_to.startswith("sim.held#")
    answer = CliRunner().invoke(
        app,
        ["train", str(copy.path), "--target", "sim.tool_y", "--align-to", "sim.phase=holding", "--permutations",
         "0", "--window", "2", "--controls", "none"],
        env={"COLUMNS": "200"},
    )  # fmt: skip
    assert "from sim.phase=holding on" in " ".join(answer.stdout.split())


@pytest.fixture(scope="module")
def results(shown_run: Run) -> ProbeResults:
    labels = Target.of_run(shown_run, "dataset.state.x")
    return train_probes(shown_run, target=labels, permutations=39, controls=("state", "instruction"))


def prepared_of(run: Run, samples: TargetSamples, names: tuple[str, ...] | None = None) -> PreparedControls:
    return prepare_controls(run, samples, False, names, None, Controls(), ("all",))


def recorded_samples(run: Run, target: str = "dataset.state.x") -> TargetSamples:
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
    samples = recorded_samples(shown_run)
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
    one_hot = step_features(samples, np.array([0, 1, 2, 3]))
    np.testing.assert_array_equal(one_hot, np.eye(4))


def test_small_pictures_are_means_of_the_stored_ones() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (2, 1, 32, 32, 3), dtype=np.uint8)
    means = small_pictures(pixels, 16).reshape(2, 16, 16, 3)
    expected = pixels[:, 0].reshape(2, 16, 2, 16, 2, 3).mean(axis=(2, 4)) / 255
    np.testing.assert_allclose(means, expected, atol=1.01 / 255)


def test_a_run_without_pixels_says_why_two_controls_are_left_out(tmp_path: Path) -> None:
    run = write_recorded_run(tmp_path / "run", 6, pixels=False)
    prepared = prepared_of(run, recorded_samples(run))
    assert prepared.names == ("step", "state", "instruction")
    assert set(prepared.left_out) == {"pixels", "random-features"}
    with pytest.raises(UsageError, match="'pixels' is not possible: the run was extracted with --no-pixels"):
        prepared_of(run, recorded_samples(run), ("pixels",))


def test_the_table_to_be_extended_has_source_frames_and_the_columns_of_the_data_set(shown_run: Run) -> None:
    table = label_frame(shown_run)
    assert len(table) == 12 * SHOWN_CALLS - 1
    assert list(table["frame"][:SHOWN_CALLS]) == [EVERY * call for call in range(SHOWN_CALLS)]
    assert set(table["source_episode"]) == set(range(12))
    assert {"dataset.timestamp", "dataset.next.reward", "dataset.state.x", "dataset.action.grip"} <= set(table)
    assert not [name for name in table if str(name).startswith(("sim.", "item."))]
    labels = Target.read(table.assign(mine=range(len(table))), "mine", task="continuous")
    assert np.isfinite(labels.coded.values).all()


def test_features_and_label_of_one_frame_belong_together(shown_run: Run) -> None:
    samples = recorded_samples(shown_run)
    site = shown_run.sites("backbone")[1]
    features = read_samples(shown_run, "mean", site, samples.rows, samples.inferences).features
    np.testing.assert_allclose(features[:, PLANTED], 5 * samples.values, rtol=1e-5)


def test_a_column_that_the_data_set_lacks_is_named_with_those_it_has(shown_run: Run, labelled_run: Path) -> None:
    with pytest.raises(UsageError, match=r"no column dataset\.next\.done; there are: dataset\.timestamp"):
        Target.of_run(shown_run, "dataset.next.done")
    with pytest.raises(UsageError, match="none, because the run is not of recordings"):
        Target.of_run(open_run(labelled_run), "dataset.next.done")


@pytest.mark.slow
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
        by_episode = table.groupby("source_episode", as_index=False)["mine"].first()
        with pytest.raises(UsageError, match=message):
            Target.read(by_episode, "mine").on(shown_run)


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
