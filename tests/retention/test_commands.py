"""What `probe-kit retention` and `compare` refuse, and how they name probes, before they read a run."""

import csv
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.commands import _keys
from probe_kit.retention.displays import collect_figures
from probe_kit.retention.report import report_html
from probe_kit.retention.training_steps import draw_training_steps, read_steps, step_table, training_step
from probe_kit.runs import open_run
from probe_kit.train import ArrayRun, ProbeResults, load_results, save_results
from probe_kit.train.results.inventory import inventory
from probe_kit.train.results.probe_results import ProbeSettings

PATHS = ["runs/pi0", "elsewhere/smolvla/", "s3://bucket/study/run"]


@pytest.mark.parametrize(
    ("choices", "keys"),
    [
        ([], [None, None, None]),
        (["runs/pi0=abc"], ["abc", None, None]),
        (["./runs/pi0/=abc", "smolvla=def"], ["abc", "def", None]),
        (["s3://bucket/study/run=123"], [None, None, "123"]),
    ],
)
def test_a_run_goes_by_its_path_or_by_the_name_of_its_folder(choices: list[str], keys: list[str | None]) -> None:
    assert _keys(PATHS, choices) == keys


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        (["abc"], "is not RUN=KEY"),
        (["runs/pi0="], "is not RUN=KEY"),
        (["other=abc"], "other is none of the runs"),
        (["pi0=abc", "runs/pi0=def"], "twice"),
    ],
)
def test_a_choice_of_probes_for_no_run_or_twice_for_one_is_refused(choices: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        _keys(PATHS, choices)


@pytest.mark.parametrize(
    "options",
    [
        ["retention", "nowhere", "--iterations", "first"],
        ["retention", "nowhere", "--epsilons", "wide"],
        ["retention", "nowhere", "--html", "."],
        ["retention", "nowhere", "--figures", __file__],
        ["compare", "nowhere", "--iterations", "first"],
        ["compare", "nowhere", "--figures", __file__],
        ["compare", "nowhere", "--kind", "steps", "--figures", __file__],
        ["compare", "nowhere", "nowhere", "--kind", "stages", "--figures", __file__],
    ],
    ids=" ".join,
)
def test_options_are_checked_before_runs_are_opened(options: list[str]) -> None:
    """The run is not there either, but that is not what is said."""
    result = CliRunner().invoke(app, options)
    assert result.exit_code == 2
    assert "is not a run" not in result.stderr
    assert "UsageError" in result.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--kind", "stages", "--rule", "box"], "--rule is not for --kind stages"),
        (["--kind", "stages", "--reference", "a"], "--reference is not for --kind stages"),
        (["--kind", "vlm-vla", "--reference", "a"], "--reference is not for --kind vlm-vla"),
        (["--kind", "vlm-vla", "--steps", "1,2"], "--steps is not for --kind vlm-vla"),
        (["--kind", "steps", "--epsilons", "0.1"], "--epsilons is not for a table of training steps"),
        (["--kind", "groups", "--as-paper"], "--as-paper is not for runs compared"),
        (["--target", "y", "--reference", "a"], "--reference is not for labels of your own"),
        (["--family", "table"], "--family is for labels of your own"),
        (["--kind", "steps", "--rule", "disc"], None),
    ],
)  # fmt: skip
def test_an_option_that_a_table_does_not_have_is_refused_by_name(options: list[str], message: str | None) -> None:
    result = CliRunner().invoke(app, ["compare", "nowhere", "elsewhere", *options])
    assert result.exit_code == 2
    assert (message or "nowhere is not a run") in " ".join(result.stderr.split())


def test_retention_of_several_runs_is_refused_with_the_line_that_compares_them() -> None:
    result = CliRunner().invoke(app, ["retention", "runs/a", "runs/b c"])
    assert result.exit_code == 2
    assert "`probe-kit compare runs/a 'runs/b c'`" in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (["retention", "a", "b", "--compare", "stages"], "`probe-kit compare RUN…`"),
        (["run", "list", "folder"], "`probe-kit run show FOLDER`"),
    ],
)
def test_an_old_spelling_is_answered_with_the_new_one(old: list[str], new: str) -> None:
    result = CliRunner().invoke(app, old)
    assert result.exit_code == 2
    assert new in " ".join(result.stderr.replace("│", " ").split())


def test_a_folder_that_is_no_run_has_nothing_to_show(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["run", "show", str(tmp_path)])
    assert result.exit_code == 2
    assert "is not a run" in result.stderr


def test_the_inventory_names_the_probes_of_a_table(
    probed_run: Callable[..., ArrayRun],
) -> None:
    run = probed_run({"color": ([0.5, 0.9], [[0.6]])})
    (probes,) = inventory(run).probes
    assert (probes.state, probes.views, probes.permutations) == ("used", ("mean",), 99)


@pytest.mark.parametrize(
    "options",
    [
        ["--score", "order-balanced"],
        ["--epsilons", "0.1"],
        ["--absent-below", "0.7"],
        ["--details", "all"],
        ["--html", "r.html"],
    ],
    ids=" ".join,
)
def test_the_papers_own_numbers_refuse_what_the_paper_does_not_have(options: list[str]) -> None:
    result = CliRunner().invoke(app, ["retention", "nowhere", "--as-paper", *options])
    assert result.exit_code == 2
    assert "--as-paper" in result.stderr


@pytest.mark.parametrize("style", ["table", "json", "csv", "markdown", "latex"])
def test_the_papers_own_numbers_are_printed_in_every_format(little_runs: Path, style: str) -> None:
    result = CliRunner().invoke(app, ["retention", str(little_runs / "run"), "--as-paper", "--format", style])
    assert result.exit_code == 0, result.stderr
    assert "color" in result.stdout.lower()
    if style == "json":
        rows = json.loads(result.stdout)
        table = retention_table([open_run(little_runs / "run")])
        assert [row["backbone"] for row in rows] == [row.backbone.peak for row in table.all_rows]
        assert all(row["margin"] == pytest.approx(0.98 / row["episodes"] ** 0.5, rel=1e-4) for row in rows[:1])


ProbedRun = Callable[..., ArrayRun]
SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7]])


def probed_again(run: ArrayRun, **changes: object) -> ProbeResults:
    """The same decisions, stored as those of other settings, and newest."""
    results = load_results(run)
    settings: ProbeSettings = replace(results.settings, **changes)  # type: ignore[arg-type]
    other = ProbeResults(settings, results.curves)
    save_results(other, run.path)
    return other


@pytest.mark.slow
def test_figures_and_report_draw_the_probes_of_the_table_not_the_newest(probed_run: ProbedRun) -> None:
    run = probed_run({"color": SIGNAL})
    older = load_results(run)
    newer = probed_again(run, permutations=50)
    table = retention_table([run], keys=[older.key])
    assert table.results_of(run.location).key == older.key
    assert {row.run.probes for row in table.all_rows} == {older.key}
    (curves,) = [exhibit for exhibit in collect_figures([run], table) if exhibit.name.endswith("layer-curves")]
    with curves.drawn() as figure:
        assert older.key in figure.get_supxlabel()
    page = report_html([run], table)
    assert older.key in page
    assert newer.key not in page
    assert retention_table([run]).results_of(run.location).key == newer.key


def test_a_table_is_not_drawn_with_runs_it_was_not_made_of(probed_run: ProbedRun) -> None:
    table = retention_table([probed_run({"color": SIGNAL}, "one")])
    with pytest.raises(UsageError, match=r"no rows of .*other"):
        collect_figures([probed_run({"color": SIGNAL}, "other")], table)


def test_a_run_given_twice_is_refused(probed_run: ProbedRun) -> None:
    run = probed_run({"color": SIGNAL})
    for doubled in ([run, run], {"a": [run], "b": [run]}):
        with pytest.raises(UsageError, match="given twice"):
            retention_table(doubled)  # type: ignore[arg-type]


def test_a_table_without_probes_says_in_one_line_what_is_missing(probed_run: ProbedRun) -> None:
    probed = probed_run({"color": SIGNAL})
    bare = replace(probed, path=probed.path.parent / "bare")
    scripted = replace(bare, path=probed.path.parent / "scripted", model="expert", features={})
    table = retention_table([probed, bare, scripted])
    assert len(table.notes) == 2
    assert f"Run `probe-kit train {bare.path}`." in table.notes[0]
    assert "of 'expert' no stream was stored" in table.notes[1]
    assert table.rows[1].success.sr == 0.6
    assert retention_table([probed]).notes == ()


def test_a_run_of_too_few_groups_is_not_sent_to_train_which_refuses_it(probed_run: ProbedRun) -> None:
    probed = probed_run({"color": SIGNAL, "shape": SIGNAL})
    episodes = probed.episodes.copy()
    for lacking, advice in (
        (
            {"color"},
            "color has 2. Extract more items. `probe-kit train PLACE --categories shape` probes the others.",
        ),
        ({"color", "shape"}, "color has 2, shape has 2. Extract more items."),
    ):
        numbers = episodes["item_id"].astype("category").cat.codes
        kinds = numbers.where(~episodes["category"].isin(lacking), numbers % 2)
        groups = kinds.astype(str) + episodes["category"]
        few = replace(probed, path=probed.path.parent / "few", episodes=episodes.assign(group_id=groups))
        (note,) = retention_table([few]).notes
        expected = advice.replace("PLACE", str(few.path))
        assert note.endswith(f"Probes need 5 independent groups of items: {expected}")


MIXTURES = {
    "permutations": (50, "label permutations 99 (one) against 50 (other)"),
    "seed": (3, "seeds 0 (one) against 3 (other)"),
    "target": ("side.chosen", "targets side.correct (one) against side.chosen (other)"),
}


FIRST, *OTHERS = MIXTURES


@pytest.mark.slow
@pytest.mark.parametrize("name", [FIRST, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)])
def test_rows_of_other_settings_are_pointed_out_in_every_format(probed_run: ProbedRun, name: str) -> None:
    value, words = MIXTURES[name]
    first, other = (probed_run({"color": SIGNAL}, model) for model in ("one", "other"))
    assert retention_table([first, other]).notes == ()
    key = probed_again(other, **{name: value}).key
    table = retention_table([first, other], keys=[None, key])
    assert words in table.notes[-1]
    for text in (table.to_markdown(), table.to_latex("all"), as_text(table), report_html([first, other], table)):
        assert words in " ".join(text.split())


def as_text(table: RetentionTable) -> str:
    import io

    from rich.console import Console

    console = Console(width=80, file=io.StringIO())
    console.print(table.to_rich("all"))
    return console.file.getvalue()  # type: ignore[attr-defined,no-any-return]


SIGNAL_TRAINING_STEPS = ([0.5, 0.9, 0.7], [[0.6, 0.8]])
WEAK = ([0.5, 0.8, 0.7], [[0.6, 0.6]])
NONE = ([0.5, 0.5, 0.5], [[0.5, 0.5]])


def of_checkpoint(path: str) -> Any:
    return SimpleNamespace(location="runs/a", certificate={"policy": {"checkpoint": path}}, settings={})


@pytest.mark.parametrize(
    ("path", "step"),
    [
        ("outputs/train/checkpoints/020000/pretrained_model", 20000),
        ("runs/checkpoint-500", 500),
        ("runs/checkpoint-500/", 500),
        ("exp/step_1000", 1000),
        ("ckpt/29999/params", 29999),
    ],
)
def test_the_step_is_that_of_the_checkpoints_folder(path: str, step: int) -> None:
    assert training_step(of_checkpoint(path)) == step


@pytest.mark.parametrize("path", ["", "embedded", "lerobot/pi0_base", "data/20261124/policy", "models/pi05"])
def test_a_folder_that_names_no_step_is_refused_and_no_date_above_is_taken_for_one(path: str) -> None:
    with pytest.raises(UsageError, match=r"training step of runs/a is unknown.*--steps 1000,2000"):
        training_step(of_checkpoint(path))


def test_steps_by_hand_are_one_per_run_and_different(probed_run: Callable[..., ArrayRun]) -> None:
    runs = [probed_run({"color": SIGNAL_TRAINING_STEPS}, name) for name in ("a", "b")]
    assert list(read_steps(["2000", "500"], runs).values()) == [2000, 500]
    for text, why in (
        ("500", "1 step for 2 runs"),
        ("500,500", "different training steps"),
        ("soon", "expected"),
    ):
        with pytest.raises(UsageError, match=why):
            read_steps(text.split(","), runs)


def test_a_row_has_the_numbers_of_its_run_and_drift_is_that_from_the_first_step(
    probed_run: Callable[..., ArrayRun],
) -> None:
    early = probed_run({"color": WEAK, "shape": NONE}, "early")
    late = probed_run({"color": SIGNAL_TRAINING_STEPS, "shape": NONE}, "late")
    table = retention_table([early, late])
    steps = {str(early.location): 500, str(late.location): 2000}
    by_step = step_table(table, steps)
    color = [record for record in by_step.numbers if record["category"] == "color"]
    assert [record["step"] for record in color] == [500, 2000]
    rows = [row for row in table.rows if row.category == "color"]
    for record, row in zip(color, rows, strict=True):
        assert (record["sr"], record["backbone"], record["retention"]) == (
            row.success.sr, row.backbone.score, row.retention.value,
        )  # fmt: skip
    assert color[0]["drift"] is None
    assert color[1]["drift"] == pytest.approx(color[1]["backbone"] - color[0]["backbone"]), (
        "the later minus the first"
    )
    assert by_step.all_notes[0].endswith(
        "drift: the backbone's accuracy minus that of the first step, paired by items where "
        "both ran the same; each with its 95 % interval; view mean; mean over Color, Shape"
    )
    shape = [record for record in by_step.numbers if record["category"] == "shape"]
    assert [record["retention"] for record in shape] == [None, None], "no signal, nothing to retain"
    cells = list(csv.DictReader(io.StringIO(by_step.to_csv())))
    assert [float(cells[0][f"backbone_ci_{end}"]) for end in ("low", "high")] == pytest.approx(
        color[0]["backbone_ci"]
    )
    assert (cells[0]["drift_ci_low"], cells[0]["drift_ci_high"]) == ("", ""), "the first step drifts from nothing"
    drawn = draw_training_steps(by_step, ())
    labels = [axes.get_ylabel() for axes in drawn.axes if axes.get_visible()]
    assert labels == ["success (%)", "backbone (%)", "retention", "drift of the backbone (points)"]
    assert [text.get_text() for text in drawn.legends[0].get_texts()][-1] == "bar: 95 % interval"


def test_a_mean_over_other_categories_stands_last_and_is_named_and_absent_columns_are_not_explained(
    probed_run: Callable[..., ArrayRun],
) -> None:
    early = probed_run({"color": NONE}, "early")
    late = probed_run({"color": SIGNAL_TRAINING_STEPS, "shape": NONE}, "late")
    by_step = step_table(retention_table([early, late]), {str(early.location): 500, str(late.location): 2000})
    assert [record["category"] for record in by_step.numbers] == ["color", "color", "shape", "mean", "mean"]
    assert by_step.all_notes[0].endswith("mean over Color (step 500), Color, Shape (step 2000)")
    bare = step_table(
        retention_table([early, late], keys=["", ""]), {str(early.location): 500, str(late.location): 2000}
    )
    assert by_step.columns[3:] == ("backbone %", "action %", "retention", "drift of the backbone, points")
    assert bare.columns == ("category", "step", "success %")
    assert bare.all_notes[0] == (
        "step: of the training; success: the cube ends on the correct picture; each with its 95 % interval; "
        "mean over Color (step 500), Color, Shape (step 2000)"
    )
