"""The options of `probe-kit train`, by help panel, and the target and the transfer that they name."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit._terminal.options import LISTED, NAMED, Names, choices, further_option, some_of, speed_option
from probe_kit.errors import UsageError
from probe_kit.statistics.folds import FoldUnit
from probe_kit.train.choices import CONTROLS, SIDES, Incomplete, Task

if TYPE_CHECKING:
    from probe_kit.train import RunReader, Target


_label_option = partial(typer.Option, rich_help_panel="Labels of your own")
_transfer_option = partial(typer.Option, rich_help_panel="Transfer")
_control_option = partial(typer.Option, rich_help_panel="Controls")
_statistics_option = partial(typer.Option, rich_help_panel="Statistics")
MOST_PERMUTATIONS = 1_000_000
MEAN = Names(("mean",))

Categories = Annotated[
    Names | None,
    typer.Option(
        "--categories",
        **NAMED,
        help="Categories to probe, each on its own, comma-separated. all: pool all episodes. Default: each "
        "category of the run for a side, all for other targets.",
    ),
]
Views = Annotated[
    Names,
    typer.Option(
        "--views",
        **LISTED,
        help="How tokens are pooled, comma-separated: mean, last, mean:ROLE. tokens and tokens:ROLE pool "
        "nothing: every token is a sample.",
    ),
]
ProbeTarget = Annotated[
    str,
    typer.Option(
        "--target",
        metavar="NAME",
        help="Label to decode. side.correct: side of the correct picture. side.chosen: side where the cube was "
        "placed. side.shuffled: correct side, flipped for half of the items. Or a column of --labels, or a "
        "built-in column such as sim.tool_y or item.named; `probe-kit targets RUN` lists them.",
    ),
]
Calls = Annotated[
    str,
    typer.Option(
        "--call",
        metavar="N,N,…|all",
        help="Captured inferences to probe, counted from 0, comma-separated. all: those with enough episodes. See "
        "`extract --captured-calls`.",
    ),
]

# -- labels of one's own -------------------------------------------------------------------------------------

LabelFile = Annotated[
    Path | None,
    _label_option(
        "--labels",
        metavar="FILE",
        help="CSV or Parquet file with a column to decode, and the key episode_id. A label per inference also "
        "has the key inference. Start from `probe-kit labels RUN`.",
    ),
]
LabelTask = Annotated[
    Task | None,
    _label_option(
        "--task",
        help="binary: one of two values. classes: one of several. continuous: a quantity, scored by R². Default: "
        "decided by the values. A column of few different integers needs this option.",
    ),
]
GroupBy = Annotated[
    str | None,
    _label_option(
        "--group-by",
        metavar="COLUMN",
        help="Column that names which rows belong together, such as the scene. Rows of one group are never split "
        "between training and test. Default: items that share a picture.",
    ),
]
ExchangeWithin = Annotated[
    str | None,
    _label_option(
        "--exchange-within",
        metavar="COLUMN",
        help="For p-values, exchange labels only between groups with one value in this column, such as category. "
        "Default: between all groups.",
    ),
]
Window = Annotated[
    int | None,
    _label_option(
        "--window",
        help="With a label per inference: number of inferences per episode. Default: the number that 90 % of the "
        "episodes reach.",
    ),
]

AlignTo = Annotated[
    str | None,
    _label_option(
        "--align-to",
        metavar="COLUMN",
        help="Begin the window of each episode where this column is first true. COLUMN=VALUE: where it first has "
        "a value, such as 'sim.phase=after release'.",
    ),
]

# -- transfer -----------------------------------------------------------------------------------------------

TestOn = Annotated[
    str | None,
    _transfer_option(
        "--test-on",
        metavar="RUN",
        help="Fit the probes on all of the first run, and score them on this one. Nothing is stored.",
    ),
]
TestLabels = Annotated[
    Path | None,
    _transfer_option(
        "--test-labels", metavar="FILE", help="Labels of the run of --test-on. Default: the file of --labels."
    ),
]
AcrossWeights = Annotated[
    bool, _transfer_option("--across-weights", help="Accept that the run of --test-on has other weights.")
]

# -- controls -----------------------------------------------------------------------------------------------

Controls = Annotated[
    Names | None,
    _control_option(
        "--controls",
        parser=some_of(CONTROLS, none="none"),
        metavar=f"{choices(CONTROLS)},…",
        help="Control features that do not come from the model, comma-separated, or none. Default for a side: "
        "random-features and pixels, if the pictures of the suite are available. Default for other targets: "
        "all that the run allows, but action and position. pixels takes as long as one or two sites.",
    ),
]
Untrained = Annotated[
    str | None,
    _control_option(
        "--untrained",
        metavar="RUN",
        help="Run of the same episodes to compare with, usually with untrained weights.",
    ),
]
Suite = Annotated[
    Path | None,
    _control_option(
        "--suite",
        metavar="FOLDER",
        help="Suite folder of the run, for pixels and random-features. Default: the embedded suite.",
    ),
]

# -- statistics ---------------------------------------------------------------------------------------------

Permutations = Annotated[
    int,
    _statistics_option(
        "--permutations", min=0, max=MOST_PERMUTATIONS, help="Number of label permutations for p-values."
    ),
]
TokenPermutations = Annotated[
    int,
    _statistics_option(
        "--token-permutations", min=0, max=MOST_PERMUTATIONS, help="Number of label permutations for token views."
    ),
]
Folds = Annotated[
    FoldUnit,
    _statistics_option(
        "--folds",
        help="What a fold must keep together. groups: items that share a picture. concepts: also items about the "
        "same two concepts.",
    ),
]
IncompleteItems = Annotated[
    Incomplete,
    _statistics_option(
        "--incomplete",
        help="What to do with items that lack one of their two episodes. keep: use the other episode. drop: "
        "leave the item out.",
    ),
]

# -- speed --------------------------------------------------------------------------------------------------

DirectionFile = Annotated[
    Path | None,
    further_option(
        "--directions",
        metavar="FILE",
        help="Also write the directions of the probes of one --call, for intervene --direction FILE#NAME: "
        "safetensors or npz.",
    ),
]
Jobs = Annotated[
    int | None,
    speed_option("--jobs", min=1, max=1024, help="Number of processes. Default: 1, or one per core with --ray."),
]
SolverDevice = Annotated[
    str | None,
    speed_option(
        "--device", help="Fit on this device with torch, such as cuda, in one process. Default: fit with numpy."
    ),
]


@dataclass(frozen=True)
class TargetOptions:
    """The options that name a target: a side, a built-in column, or a column of a table."""

    name: str
    file: Path | None
    task: Task | None
    group_by: str | None
    exchange_within: str | None
    align_to: str | None = None

    def check(self, window: int | None) -> None:
        """Raise UsageError for a target that has no source, and for a side with options that no side has."""
        from probe_kit.train.builtin_columns import builtin_names, is_builtin

        sides = ", ".join(map(repr, SIDES))
        if self.file is not None and not self.is_label:
            raise UsageError(
                f"--target {self.name} is a side, and --labels {self.file} is given. Name a column of the table "
                "with --target; rename the column if it is called so"
            )
        if self.file is None and self.is_label and not is_builtin(self.name):
            raise UsageError(
                f"--target {self.name!r} is not one of {sides}, nor a built-in column "
                f"({', '.join(builtin_names())}). `probe-kit targets RUN` lists those of a run, such as "
                "dataset.NAME; give the table of another column with --labels FILE"
            )
        options = {
            "--task": self.task, "--group-by": self.group_by, "--exchange-within": self.exchange_within,
            "--window": window, "--align-to": self.align_to,
        }  # fmt: skip
        present = [option for option, value in options.items() if value is not None]
        if present and not self.is_label:
            raise UsageError(
                f"{present[0]} is for labels of your own and built-in columns; give --target COLUMN too, and "
                "--labels FILE for one of a table"
            )

    @property
    def is_label(self) -> bool:
        """Whether the target is a built-in column or one of a table, and no side of a picture."""
        return self.name not in SIDES

    def read(self, run: "RunReader", file: Path | None = None, seed: int = 0) -> "Target":
        """Return the target for a run: from the table, from another `file`, or built in."""
        from probe_kit.train import Target

        options = self.task, self.group_by, self.exchange_within
        if (table := file or self.file) is None:
            return Target.of_run(run, self.name, *options, seed=seed)
        return Target.read(table, self.name, *options)

    def event(self, run: "RunReader") -> "Target | None":
        """Return the column that says where windows begin; for `COLUMN=VALUE` whether the column has the value."""
        from probe_kit.train import Target
        from probe_kit.train.builtin_columns import is_builtin

        if self.align_to is None:
            return None
        name, equals, value = self.align_to.partition("=")
        event = Target.of_run(run, name) if self.file is None or is_builtin(name) else Target.read(self.file, name)
        return event.equal_to(value) if equals else event
