"""Retention, success and drift of several checkpoints of one training, against the training step."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from probe_kit._system.counting import counted
from probe_kit._tables.numbers import number, percent, points, with_limits
from probe_kit._tables.table import Table
from probe_kit.errors import UsageError
from probe_kit.retention.behaviour import ask_of
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.compare.models import checkpoint_of, split_checkpoint
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.retention.table import RetentionTable
from probe_kit.runs.reader import RunReader

_COLUMNS = {
    "category": "",
    "step": "step: of the training",
    "success %": "success: the cube ends on the correct picture",
    "backbone %": "backbone: accuracy of probes in the backbone",
    "action %": "action: the same at the action's sites",
    "retention": "retention: share of the backbone's signal left in the action",
    "drift of the backbone, points": "drift: the backbone's accuracy minus that of the first step, paired by "
    "items where both ran the same",
}
"""The meaning of each column, which the note gives of those that are shown."""


def training_step(run: RunReader) -> int:
    """Return the training step of the run's checkpoint, from the last folder of its path.

    Raises UsageError for a run whose checkpoint is unknown or names no step.
    """
    checkpoint = checkpoint_of(run)
    if (training := split_checkpoint(checkpoint)) is not None:
        return training[1]
    raise UsageError(
        f"the training step of {run.location} is unknown: its checkpoint is {checkpoint or 'not stored'!r}; "
        "expected a folder such as checkpoints/020000 or checkpoint-500. Give the steps in the order of the runs, "
        "such as --compare steps=1000,2000"
    )


def read_steps(text: str | None, runs: Sequence[RunReader]) -> dict[str, int]:
    """Return the training step of every run by its location; text: comma-separated numbers, None for the folders'.

    Raises UsageError for another text, a number of steps that is not that of the runs, runs of one step, or VLM
    runs, which have no retention.
    """
    if vlms := [str(run.location) for run in runs if ask_of(run) is not None]:
        raise UsageError(f"--compare steps is for policy runs; {vlms[0]} is a VLM run. Leave it out")
    if text is None:
        steps = [training_step(run) for run in runs]
    else:
        parts = [part.strip() for part in text.split(",")]
        if not all(part.isdecimal() for part in parts):
            raise UsageError(f"--compare steps={text}; expected a training step per run, such as steps=1000,2000")
        steps = [int(part) for part in parts]
    if len(steps) != len(runs):
        raise UsageError(
            f"--compare steps has {counted(len(steps), 'step')} for {counted(len(runs), 'run')}; give one per "
            "run, in order"
        )
    if len(runs) < 2 or len(set(steps)) < len(steps):
        raise UsageError(
            "--compare steps needs several runs of different training steps; these are of "
            f"{', '.join(map(str, steps))}"
        )
    return {str(run.location): step for run, step in zip(runs, steps, strict=True)}


def step_table(table: RetentionTable, steps: Mapping[str, int]) -> Table:
    """Return success, backbone, action, retention and drift by category and training step.

    table: of runs in the order of their steps, the first of which all others are compared with. steps: by
    location. Keys of a row's numbers: `category`, `step`, `run`, `view`, `sr`, `backbone`, `action`, `retention`,
    `drift` (of the backbone) and, for each of them, its limits under the name with `_ci`.
    """
    first: dict[str, str | None] = {}  # the first view of each run, which its rows are of
    rows = [row for row in table.all_rows if first.setdefault(row.run.location, row.view) == row.view]
    drifts = {(gap.run, gap.category): gap for gap in table.differences if gap.view in (*first.values(), None)}
    names = sorted(dict.fromkeys(row.category for row in rows), key=lambda name: name == MEAN)
    ordered = sorted(rows, key=lambda row: (names.index(row.category), steps[row.run.location]))
    numbers = [_numbers(row, steps, drifts) for row in ordered]
    means = [row for row in ordered if row.category == MEAN]
    views = {steps[row.run.location]: row.view for row in means if row.view is not None}
    steps_table = Table.of(
        "Training steps", tuple(_COLUMNS), [_cells(row) for row in numbers], names=2, numbers=tuple(numbers),
        mean=title_of(MEAN),
    ).filled("n/a")  # fmt: skip
    notes = [
        *(_COLUMNS[name] for name in steps_table.columns if _COLUMNS[name]),
        "each with its 95 % interval",
        _by_step("view", {step: str(view) for step, view in views.items()}),
        _by_step(
            "mean over", {steps[row.run.location]: ", ".join(map(title_of, row.categories)) for row in means}
        ),
    ]
    return replace(steps_table, notes=("; ".join(filter(None, notes)),))


def _by_step(name: str, values: Mapping[int, str]) -> str:
    """Return `name` with the value that all steps share, or with the value of each step."""
    if len(set(values.values())) > 1:
        each = ", ".join(f"{value} (step {step})" for step, value in values.items())
        return f"{name} {each}"
    return f"{name} {next(iter(values.values()))}" if values else ""


def _numbers(
    row: RetentionRow, steps: Mapping[str, int], drifts: Mapping[tuple[str | None, str], Any]
) -> dict[str, Any]:
    drift = drifts.get((row.run.location, row.category))
    defined = row.retention.defined
    return {
        "category": row.category,
        "step": steps[row.run.location],
        "run": row.run.location,
        "view": row.view,
        "sr": row.success.sr,
        "sr_ci": row.success.ci,
        "backbone": row.backbone.score,
        "backbone_ci": row.backbone.ci,
        "action": row.action.score,
        "action_ci": row.action.ci,
        "retention": row.retention.value if defined else None,
        "retention_ci": row.retention.ci if defined else None,
        "drift": None if drift is None else drift.backbone,
        "drift_ci": None if drift is None else drift.backbone_ci,
    }


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    shares = (with_limits(row[name], row[f"{name}_ci"], percent) for name in ("sr", "backbone", "action"))
    ratio = with_limits(row["retention"], row["retention_ci"], number)
    lacks = row["retention"] is None and row["backbone"] is not None and row["action"] is not None
    drift = with_limits(row["drift"], row["drift_ci"], points)
    return (title_of(row["category"]), str(row["step"]), *shares, "n/a" if lacks else ratio, drift)
