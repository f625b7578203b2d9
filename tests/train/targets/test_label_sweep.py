"""Probes of a label in a stored run: signal, controls, what is stored, and what is refused."""

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
from probe_kit.train import Target, load_results, train_probes
from probe_kit.train.target_samples import target_samples
from tests.support.labelled_run import CALLS

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
    others = scores.drop("backbone.01.residual")
    assert (others["score"] < 0.3).all()
    assert planted["exceeds_step"]
    assert planted["exceeds_instruction"]
    assert not planted["exceeds_state"], "the state holds the hand itself"
    assert not planted["signal"]
    assert planted["best_control"] > 0.99
    assert results.left_out == {f"episodes that end before inference {CALLS - 1}": 1}
    assert planted["n"] == CALLS * planted["episodes"] == CALLS * (len(run.episodes) - 1)


def test_without_a_control_that_explains_it_a_planted_quantity_is_a_signal(run: Run) -> None:
    labels = Target.of_run(run, "sim.tool_y")
    results = train_probes(run, target=labels, permutations=59, controls=("step", "instruction"))
    signal = results.scores.set_index("site")["signal"]
    assert signal[signal].index.tolist() == ["backbone.01.residual"]


def test_what_is_stored_is_loaded_and_controls_are_added_without_a_second_fit(
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
        own, other = (results.curves["all", "mean"] for results in (loaded, second))
        for name in ("labels", "episodes", "inferences", "groups", "fold_of"):
            assert (getattr(own, name) == getattr(other, name)).all()
    assert CliRunner().invoke(app, ["run", "verify", "--deep", str(run.location)]).exit_code == 0
    shown = CliRunner().invoke(app, ["run", "show", str(run.location)]).stdout
    assert f"probes {first.key}" in shown
    assert "of a label of your own" in " ".join(shown.split())
    assert "target sim.tool_y (continuous)" in " ".join(shown.split())


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


def test_another_value_group_stratum_or_window_is_another_key(run: Run) -> None:
    frame = by_group(run, lambda draw: float(draw.normal()))
    frame["half"] = run.episodes["group_id"].map(lambda name: int(name[-1], 16) % 2)
    other = frame.assign(y=frame["y"] + 1)

    def key(table: pd.DataFrame, **further: str) -> str:
        results = train_probes(run, target=Target.read(table, "y", **further), permutations=0, controls=())  # type: ignore[arg-type]
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


def samples_of(run: Run, table: pd.DataFrame, **further: object) -> object:
    task = further.pop("task", None)
    names = {name: further.pop(name, None) for name in ("group_by", "exchange_within")}
    labels = Target.read(table, "y", task=task, **names)  # type: ignore[arg-type]
    return target_samples(run, labels, further.get("categories"), further.get("call", 0), further.get("window"))  # type: ignore[arg-type]


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
    assert not results.settings.is_side
    assert load_results(run, target="correct").key == results.key


def test_the_command_prints_one_table_and_a_sentence(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "own.csv"
    by_group(run, lambda draw: float(draw.normal())).to_csv(file, index=False)
    options = ["--permutations", "9", "--controls", "instruction"]
    done = CliRunner().invoke(
        app, ["train", str(run.location), "--labels", str(file), "--target", "y", *options], env={"COLUMNS": "100"}
    )
    assert done.exit_code == 0, done.stderr
    assert "y not testable in the backbone and the action expert: train with --permutations" in " ".join(
        done.stdout.split()
    )
    assert f"y (continuous), {len(run.episodes)} numbers" in done.stdout
    assert "control instruction" in done.stdout
    assert done.stdout.splitlines()[0] == Target.read(file, "y").contents
    assert load_results(run, target="y").settings.target == "y"


def test_the_command_prints_the_classes_once_with_their_counts(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "own.csv"
    by_group(run, lambda draw: str(draw.choice(["Yes", "no"]))).to_csv(file, index=False)
    lines = file.read_text(encoding="utf-8").splitlines()
    lines[1] = lines[1].rpartition(",")[0] + ",NA"
    file.write_text("\n".join(lines), encoding="utf-8")
    options = ["--labels", str(file), "--target", "y", "--permutations", "0", "--controls", "instruction"]
    done = CliRunner().invoke(app, ["train", str(run.location), *options], env={"COLUMNS": "100"})
    assert done.exit_code == 0, done.stderr
    counts = {word: sum(line.endswith(f",{word}") for line in lines) for word in ("no", "Yes")}
    line = f"y (binary), 2 classes: no {counts['no']}, yes {counts['Yes']}; 1 missing"
    assert done.stdout.splitlines().count(line) == 1


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
    done = CliRunner().invoke(app, ["train", str(labelled_run), *options])
    assert done.exit_code == 2
    assert expected in str(done.exception) or expected in done.stderr
