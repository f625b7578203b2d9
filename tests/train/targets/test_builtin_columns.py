"""Built-in columns of a run, and the table that `probe-kit labels` writes."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env.scoring import CHANNELS
from probe_kit.errors import ProbeKitError, UsageError
from probe_kit.runs import open_run
from probe_kit.train import Target, train_probes
from probe_kit.train.choices import SIDES
from probe_kit.train.columns.builtin import SIM_COLUMNS, builtin_names, label_frame
from probe_kit.train.target_commands import CONSTANT, listed_targets
from tests.support.labelled_run import CALLS, EVERY, GRASP, RELEASE


def test_columns_of_the_simulation_are_the_stored_state_at_the_step_of_each_inference(labelled_run: Path) -> None:
    run = open_run(labelled_run)
    frame = label_frame(run)
    assert len(frame) == CALLS * len(run.episodes) - 2, "the last episode ended after two inferences"
    assert frame["control_step"].tolist()[:CALLS] == [0, EVERY, 2 * EVERY, 3 * EVERY]
    row, seen = frame.iloc[CALLS + 2], run.trajectory(1).frames[2 * EVERY]
    state = dict(zip(CHANNELS, seen.tolist(), strict=True))
    for name in ("tool", "cube"):
        assert [row[f"sim.{name}_{axis}"] for axis in "xyz"] == [state[f"{name}.{axis}"] for axis in "xyz"]
    tile = f"tile_{run.episodes['side_correct'].iloc[1]}"
    away = [state[f"cube.{axis}"] - state[f"{tile}.{axis}"] for axis in "xy"]
    assert row["sim.distance_correct"] == pytest.approx(np.hypot(*away), rel=1e-6)
    steps = frame["control_step"]
    whole = frame["episode_id"] != run.episodes["episode_id"].iloc[-1]
    assert (frame["sim.steps_to_grasp"] == GRASP - steps).all()
    assert (frame["sim.held"] == ((steps >= GRASP) & (steps < RELEASE))).all()
    phases = np.select([steps < GRASP, steps < RELEASE], ["before grasp", "holding"], "after release")
    assert (frame["sim.phase"] == phases)[whole].all()


def test_columns_of_the_item_name_its_pictures(labelled_run: Path) -> None:
    run = open_run(labelled_run)
    first = label_frame(run).groupby("episode_id", sort=False).first()
    for episode, row in run.episodes.set_index("episode_id").iterrows():
        own = first.loc[episode]
        assert (own["item.named"], own["item.other"]) == (row["target_concept"], row["distractor_concept"])
        left = row["target_concept"] if row["side_correct"] == "left" else row["distractor_concept"]
        assert own["item.left"] == left
        assert own["item.pair"].split(" / ") == sorted([row["target_concept"], row["distractor_concept"]])
        assert own["item.category"] == row["category"]


def test_every_built_in_column_is_the_same_from_the_run_and_from_its_table(
    labelled_run: Path, tmp_path: Path
) -> None:
    file = tmp_path / "labels.csv"
    written = CliRunner().invoke(app, ["labels", str(labelled_run), "--out", str(file)])
    assert written.exit_code == 0, written.stderr
    for name in set(builtin_names()) - {"item.category"}:
        assert name in written.stdout
        built_in = Target.of_run(open_run(labelled_run), name)
        read = Target.read(file, name, task=built_in.task)
        assert read.coded.classes == built_in.coded.classes, name
        assert (read.sha256 == built_in.sha256) == name.startswith("sim."), "items have no inference"
    assert CliRunner().invoke(app, ["labels", str(labelled_run), "--out", str(file)]).exit_code == 2, "it exists"


def test_a_constant_or_unknown_column_is_refused_by_name(labelled_run: Path) -> None:
    run = open_run(labelled_run)
    assert ("item.category", CONSTANT) in [row[:2] for row in listed_targets(run.only(["color"]))]
    constant = {name for name, task, *_ in listed_targets(run) if task == CONSTANT}
    assert not {"item.category", *SIDES} & constant
    with pytest.raises(UsageError, match=r"'item.category' has one value"):
        Target.of_run(run.only(["color"]), "item.category")
    with pytest.raises(UsageError, match=r"no built-in column 'sim.tool_w'; there are: sim.tool_x"):
        Target.of_run(run, "sim.tool_w")


def test_a_target_has_options_exactly_where_train_accepts_it(labelled_run: Path, tmp_path: Path) -> None:
    shutil.copytree(labelled_run, tmp_path / "run")
    run = open_run(tmp_path / "run")
    rows = {row.target: row for row in listed_targets(run) if row.options is not None or row.refused}
    assert rows["side.correct"].options == ""
    assert rows["sim.held"].options == " --target sim.held"
    assert rows["side.chosen"].options is None
    assert "0 independent groups" in rows["side.chosen"].refused
    for name, row in rows.items():
        target = Target.of_run(run, name, task="classes" if "--task classes" in (row.options or "") else None)
        if row.options is None:
            with pytest.raises(ProbeKitError) as refusal:
                train_probes(run, target=target, permutations=0, controls=())
            assert row.refused in str(refusal.value)
        else:
            train_probes(run, target=target, permutations=0, controls=())


def test_a_category_with_too_few_groups_is_left_out_of_the_command(labelled_run: Path, tmp_path: Path) -> None:
    shutil.copytree(labelled_run, tmp_path / "run")
    for commit in sorted((tmp_path / "run" / "commits").iterdir())[-12:]:
        commit.unlink()
    for sealed in ("sealed", "columns.zarr"):
        shutil.rmtree(tmp_path / "run" / sealed)
    run = open_run(tmp_path / "run", allow_partial=True)
    assert run.episodes.groupby("category")["group_id"].nunique().to_dict() == {"color": 6, "shape": 3}
    assert next(iter(listed_targets(run))).options == " --categories color"


def test_a_run_that_did_not_act_has_no_chosen_side(labelled_run: Path) -> None:
    run = open_run(labelled_run)
    run.episodes.drop(columns=["side_placed"], inplace=True)
    with pytest.raises(UsageError, match=r"captured without acting"):
        Target.of_run(run, "side.chosen")


def test_a_target_is_added_by_the_entry_that_contributing_shows(
    labelled_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The diff of CONTRIBUTING is applied; list, table and probes then have the target."""
    page = (Path(__file__).parents[3] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    diff = page.partition("## To add a target")[2].partition("```diff")[2].partition("```")[0]
    added = "\n".join(line[1:] for line in diff.splitlines() if line.startswith("+ "))
    (entry,) = eval(f"{{{added}}}", {"np": np}).items()
    monkeypatch.setitem(SIM_COLUMNS, *entry)
    shutil.copytree(labelled_run, tmp_path / "run")
    run = open_run(tmp_path / "run")
    assert "sim.speed" in [name for name, *_ in listed_targets(run)]
    assert label_frame(run)["sim.speed"].min() >= 0
    results = train_probes(run, target="sim.speed", permutations=0, controls=("step",))
    assert results.settings.task == "continuous"
