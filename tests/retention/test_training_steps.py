"""Checkpoints of one training: the step is read or refused, and the table holds the numbers of the runs."""

import csv
import io
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from probe_kit.errors import UsageError
from probe_kit.retention import retention_table
from probe_kit.retention.displays.training_steps import draw_training_steps
from probe_kit.retention.training_steps import read_steps, step_table, training_step
from probe_kit.train import ArrayRun

SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.8]])
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
    with pytest.raises(UsageError, match=r"training step of runs/a is unknown.*--compare steps=1000,2000"):
        training_step(of_checkpoint(path))


def test_steps_by_hand_are_one_per_run_and_different(probed_run: Callable[..., ArrayRun]) -> None:
    runs = [probed_run({"color": SIGNAL}, name) for name in ("a", "b")]
    assert list(read_steps("2000,500", runs).values()) == [2000, 500]
    for text, why in (
        ("500", "1 step for 2 runs"),
        ("500,500", "different training steps"),
        ("soon", "expected"),
    ):
        with pytest.raises(UsageError, match=why):
            read_steps(text, runs)


def test_a_row_has_the_numbers_of_its_run_and_drift_is_that_from_the_first_step(
    probed_run: Callable[..., ArrayRun],
) -> None:
    early = probed_run({"color": WEAK, "shape": NONE}, "early")
    late = probed_run({"color": SIGNAL, "shape": NONE}, "late")
    table = retention_table([early, late])
    steps = {str(early.location): 500, str(late.location): 2000}
    made = step_table(table, steps)
    color = [one for one in made.numbers if one["category"] == "color"]
    assert [one["step"] for one in color] == [500, 2000]
    rows = [row for row in table.rows if row.category == "color"]
    for one, row in zip(color, rows, strict=True):
        assert (one["sr"], one["backbone"], one["retention"]) == (
            row.success.sr, row.backbone.score, row.retention.value,
        )  # fmt: skip
    assert color[0]["drift"] is None
    assert color[1]["drift"] == pytest.approx(color[1]["backbone"] - color[0]["backbone"]), (
        "the later minus the first"
    )
    assert made.notes[0].endswith(
        "drift: the backbone's accuracy minus that of the first step, paired by items where "
        "both ran the same; each with its 95 % interval; view mean; mean over Color, Shape"
    )
    shape = [one for one in made.numbers if one["category"] == "shape"]
    assert [one["retention"] for one in shape] == [None, None], "no signal, nothing to retain"
    cells = list(csv.DictReader(io.StringIO(made.to_csv())))
    assert [float(cells[0][f"backbone_ci_{end}"]) for end in ("low", "high")] == pytest.approx(
        color[0]["backbone_ci"]
    )
    assert (cells[0]["drift_ci_low"], cells[0]["drift_ci_high"]) == ("", ""), "the first step drifts from nothing"
    drawn = draw_training_steps(made, ())
    labels = [axes.get_ylabel() for axes in drawn.axes if axes.get_visible()]
    assert labels == ["success (%)", "backbone (%)", "retention", "drift of the backbone (points)"]


def test_a_mean_over_other_categories_stands_last_and_is_named_and_absent_columns_are_not_explained(
    probed_run: Callable[..., ArrayRun],
) -> None:
    early = probed_run({"color": NONE}, "early")
    late = probed_run({"color": SIGNAL, "shape": NONE}, "late")
    made = step_table(retention_table([early, late]), {str(early.location): 500, str(late.location): 2000})
    assert [one["category"] for one in made.numbers] == ["color", "color", "shape", "mean", "mean"]
    assert made.notes[0].endswith("mean over Color (step 500), Color, Shape (step 2000)")
    bare = step_table(
        retention_table([early, late], keys=["", ""]), {str(early.location): 500, str(late.location): 2000}
    )
    assert made.columns[3:] == ("backbone %", "action %", "retention", "drift of the backbone, points")
    assert bare.columns == ("category", "step", "success %")
    assert bare.notes[0] == (
        "step: of the training; success: the cube ends on the correct picture; each with its 95 % interval; "
        "mean over Color (step 500), Color, Shape (step 2000)"
    )
