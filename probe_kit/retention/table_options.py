"""Options of `probe-kit retention` and `probe-kit compare`: a class per table, whose fields are its options.

An option that a table has no field for is refused by name. So no command knows which option goes with which table.
"""

from collections.abc import Mapping
from math import inf
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, cast, get_args

import typer

from probe_kit._tables.printing import Format
from probe_kit._terminal import options as common
from probe_kit._terminal.console import split, whole_number
from probe_kit._terminal.field_options import Part, options_of
from probe_kit._terminal.options import Names, choices, some_of
from probe_kit.errors import UsageError
from probe_kit.retention.choices import AnswerScore, Family, Iterations, Section
from probe_kit.scene_names import RuleName

RUNS = "Probes"
RULES = "Outcome rule"
VLM_RUNS = "VLM runs"


class Radii(tuple[float, ...]):
    """Zone radii in metres."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: "str | Radii") -> "Radii":
        """Return the numbers of a comma-separated text.

        Raises:
            UsageError: For one that is not positive.
        """
        return cls(map(_radius, split(text) or ())) if isinstance(text, str) else text

    def __str__(self) -> str:
        """Return the radii as they are typed."""
        return ",".join(f"{radius:g}" for radius in self)


def _radius(text: str) -> float:
    try:
        radius = float(text)
    except ValueError:
        raise UsageError(f"{text!r} is not a number of metres") from None
    if not 0 < radius < inf:
        raise UsageError(f"a zone radius is {text} m; expected a positive number")
    return radius


def read_iterations(text: str) -> Iterations:
    """Return `all`, `best`, `last` or a number.

    Raises:
        UsageError: For another text.
    """
    if (number := whole_number(text)) is not None:
        return number
    if text not in ("all", "best", "last"):
        raise UsageError(f"iterations {text!r}; expected all, best, last or a number")
    return cast("Iterations", text)


# -- options ---------------------------------------------------------------------------------------------------

LabelTargets = Annotated[
    tuple[str, ...],
    typer.Option(
        "--target",
        metavar="COLUMN",
        help="Column of your own labels whose retention is shown; repeat for several in one table. Default: the "
        "side of the correct picture.",
        rich_help_panel=RUNS,
    ),
]
LabelFamily = Annotated[
    Family,
    typer.Option(
        "--family",
        help="What p is corrected for. label: the sites of one target. table: also all other targets of the "
        "table (Holm).",
        rich_help_panel=RUNS,
    ),
]
ProbeKeys = Annotated[
    tuple[str, ...],
    typer.Option(
        "--probes",
        metavar="RUN=KEY",
        help="Probe results of a run; `probe-kit run show` lists them. Default: those requested last.",
        rich_help_panel=RUNS,
    ),
]
Views = Annotated[
    tuple[str, ...] | None,
    typer.Option(
        "--views",
        parser=Names.parse,
        metavar="A,B,…",
        help="Token views, comma-separated. Default: all that were probed.",
        rich_help_panel=RUNS,
    ),
]
IterationChoice = Annotated[
    str,
    typer.Option(
        "--iterations",
        metavar="all|best|last|N",
        help="Which iterations of the action stream count: flow steps or action tokens, not training steps. "
        "best: layer curves show the best one only.",
        rich_help_panel=RUNS,
    ),
]
AbsentBelow = Annotated[
    float,
    typer.Option(
        "--absent-below",
        min=0.5,
        max=1.0,
        help="A stream without signal is called absent if its accuracy is below this in all likelihood: its "
        "upper 95 % limit.",
        rich_help_panel=RUNS,
    ),
]

# -- outcome rule ------------------------------------------------------------------------------------------------

Rule = Annotated[
    RuleName,
    typer.Option(
        "--rule",
        help="Rule by which an episode counts as answered. box: that of the released evaluation.",
        rich_help_panel=RULES,
    ),
]
LastSteps = Annotated[
    int,
    typer.Option(
        "--last-steps",
        min=1,
        help="Number of control steps at the end of an episode that --rule judges; success is their mean. The "
        "released evaluation uses 11.",
        rich_help_panel=RULES,
    ),
]
Epsilons = Annotated[
    tuple[float, ...] | None,
    typer.Option(
        "--epsilons",
        parser=Radii.parse,
        metavar="A,B,…",
        help="Radii of the target zone in metres, comma-separated. Success by the rule disc is counted again "
        "with each, from stored positions.",
        rich_help_panel=RULES,
    ),
]

# -- VLM runs ----------------------------------------------------------------------------------------------------

Score = Annotated[
    AnswerScore,
    typer.Option(
        "--score",
        help="How answers of VLM runs are read. text: from the words. logits: the larger "
        "logit. order-balanced: the same over both orders of the options.",
        rich_help_panel=VLM_RUNS,
    ),
]
SideWords = Annotated[
    bool,
    typer.Option(
        "--with-side-words",
        help="Also count items that name a side in their words, such as 'no left turn sign'.",
        rich_help_panel=VLM_RUNS,
    ),
]

# -- output ------------------------------------------------------------------------------------------------------

Details = Annotated[
    tuple[str, ...] | None,
    typer.Option(
        "--details",
        parser=some_of((*get_args(Section), "all")),
        metavar=f"{choices((*get_args(Section), 'all'))},…",
        help="Tables to print above the summary, comma-separated. all: every table, and every figure of "
        "--figures.",
    ),
]
AsPaper = Annotated[
    bool,
    typer.Option(
        "--as-paper",
        help="Print the paper's own numbers by its own formulas: regimes by Δ over episodes alone, retention of "
        "maxima with ε over all categories. No intervals, no controls.",
    ),
]
Html = Annotated[
    Path | None,
    typer.Option(
        "--html", metavar="FILE", help="Write all results as one HTML file that opens without a network."
    ),
]
Figures = Annotated[
    Path | None,
    typer.Option(
        "--figures",
        metavar="FOLDER",
        help="Write the main figures as PNG and PDF; with --details all every figure.",
    ),
]


Reference = Annotated[
    str | None,
    typer.Option(
        "--reference",
        metavar="NAME",
        help="Run or group that is subtracted from every other. Default: the first run; every two groups.",
    ),
]
Steps = Annotated[
    tuple[str, ...] | None,
    typer.Option(
        "--steps",
        parser=Names.parse,
        metavar="N,N,…",
        help="With --kind steps: training steps in the order of the runs. Default: those of the folders of their "
        "checkpoints.",
    ),
]

# -- tables ------------------------------------------------------------------------------------------------------


class TableOptions(Part):
    """Options of every table.

    Attributes:
        probes: Chosen probe results, as RUN=KEY.
        views: Views of the tokens; None for all.
        wording: Wording that is read; None for the first.
        style: Format of the printed table.
    """

    probes: ProbeKeys = ()
    views: Views = None
    wording: common.Wording = None
    style: Format = "table"

    table: ClassVar[str]
    """Name of the table in messages."""

    @classmethod
    def of_typed(cls, typed: Mapping[str, Any]) -> Self:
        """Return the options with the values that were typed, by the name of their parameter.

        Raises:
            UsageError: For an option that this table does not have.
        """
        fields = {option.parameter: option.field for option in options_of(cls)}
        common.check_no_others({f"--{name.replace('_', '-')}": name not in fields for name in typed}, cls.table)
        return cls(**{fields[name]: value for name, value in typed.items()})


class FigureOptions(TableOptions):
    """Options of a table with figures.

    Attributes:
        figures: Folder of the figures; None for no figure.
    """

    figures: Figures = None

    def check_files(self) -> None:
        """Raise UsageError for a path that cannot be written."""
        check_file(self.figures)


class RunTableOptions(TableOptions):
    """Options of a table with rows of runs.

    Attributes:
        iterations: Iterations of the action stream, as they were typed.
        partial: Whether unfinished runs are read.
    """

    iterations: IterationChoice = "all"
    partial: common.Partial = False

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `retention_table` that only this table has.

        Raises:
            UsageError: For values that contradict each other.
        """
        return {}


class RuleOptions(Part):
    """Options of a table with success rates.

    Attributes:
        rule: Rule by which an episode counts as answered.
        last_steps: Number of control steps that it judges.
    """

    rule: Rule = "disc"
    last_steps: LastSteps = 1


class AnswerOptions(Part):
    """Options of a table with answers of VLM runs.

    Attributes:
        score: How answers are read.
        with_side_words: Whether items that name a side in their words count.
    """

    score: Score = "text"
    with_side_words: SideWords = False


class PageOptions(FigureOptions):
    """Options of a table with sections and a report.

    Attributes:
        details: Sections above the summary.
        html: File of the report; None for no report.
    """

    details: Details = None
    html: Html = None

    def check_files(self) -> None:
        """Raise UsageError for a path that cannot be written."""
        if self.html is not None and self.html.is_dir():
            raise UsageError(f"--html {self.html} is a folder; give a file, such as {self.html / 'report.html'}")
        super().check_files()


class SideTableOptions(PageOptions, RunTableOptions, RuleOptions, AnswerOptions):
    """Options of the retention of the side of the correct picture.

    Attributes:
        absent_below: Upper limit of an absent stream's accuracy.
        epsilons: Radii of the target zone in metres; None for the default ones.
    """

    absent_below: AbsentBelow = 0.65
    epsilons: Epsilons = None

    table: ClassVar[str] = "sides of the correct picture"

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `retention_table` that only this table has."""
        from probe_kit.retention.behaviour import check_epsilons

        check_epsilons(self.rule, self.epsilons is not None)
        radii = {} if self.epsilons is None else {"epsilons": self.epsilons}
        return radii | {
            "rule": self.rule,
            "last_steps": self.last_steps,
            "absent_below": self.absent_below,
            "score": self.score,
            "with_side_words": self.with_side_words,
        }


class LabelTableOptions(PageOptions, RunTableOptions):
    """Options of the retention of labels of your own.

    Attributes:
        target: Columns of labels.
        family: Tests that p is corrected for.
    """

    target: LabelTargets
    family: LabelFamily = "label"

    table: ClassVar[str] = "labels of your own"

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `retention_table` that only this table has."""
        return {"target": self.target, "family": self.family}


class PaperTableOptions(RunTableOptions, RuleOptions, AnswerOptions):
    """Options of the paper's own numbers.

    Attributes:
        as_paper: True; the option that requests the table.
    """

    as_paper: AsPaper = False

    table: ClassVar[str] = "the paper's own numbers (--as-paper)"

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `retention_table` that only this table has."""
        common.check_no_others({f"--score {self.score}": self.score == "order-balanced"}, "--as-paper")
        return {
            "rule": self.rule,
            "last_steps": self.last_steps,
            "score": self.score,
            "with_side_words": self.with_side_words,
        }


class ComparisonOptions(SideTableOptions):
    """Options of runs or groups beside each other.

    Attributes:
        reference: The run or group that is subtracted; None for the default.
    """

    reference: Reference = None

    table: ClassVar[str] = "runs compared with each other"


class VlmTableOptions(SideTableOptions):
    """Options of VLM runs beside policy runs."""

    table: ClassVar[str] = "--kind vlm-vla"


class StageTableOptions(FigureOptions, AnswerOptions):
    """Options of a VLM and a policy, question by question."""

    table: ClassVar[str] = "--kind stages"


class StepTableOptions(FigureOptions, RunTableOptions, RuleOptions):
    """Options of checkpoints of one training.

    Attributes:
        absent_below: Upper limit of an absent stream's accuracy.
        steps: Training steps in the order of the runs; None for those of the folders.
    """

    absent_below: AbsentBelow = 0.65
    steps: Steps = None

    table: ClassVar[str] = "a table of training steps (--kind steps)"

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `retention_table` that only this table has."""
        return {"rule": self.rule, "last_steps": self.last_steps, "absent_below": self.absent_below}


def check_file(figures: Path | None) -> None:
    """Raise UsageError if figures should go to a path that is a file."""
    if figures is not None and figures.exists() and not figures.is_dir():
        raise UsageError(f"--figures {figures} is a file; give a folder")
