"""Options of `probe-kit retention`, by help panel."""

from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast, get_args

import typer

from probe_kit._terminal.console import split, whole_number
from probe_kit._terminal.options import Names, choices, some_of
from probe_kit.errors import UsageError
from probe_kit.retention.choices import AnswerScore, Family, Section
from probe_kit.scene_names import RuleName

if TYPE_CHECKING:
    from probe_kit.retention.choices import Iterations

RUNS = "Probes"
RULES = "Outcome rule"
VLM_RUNS = "VLM runs"


class Radii(tuple[float, ...]):
    """Zone radii in metres."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: "str | Radii") -> "Radii":
        """The numbers of a comma-separated text. Raises UsageError for one that is not positive."""
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


def read_iterations(text: str) -> "Iterations":
    """all, best, last or a number. Raises UsageError for another text."""
    if (number := whole_number(text)) is not None:
        return number
    if text not in ("all", "best", "last"):
        raise UsageError(f"iterations {text!r}; expected all, best, last or a number")
    return cast("Iterations", text)


# -- runs and probes ---------------------------------------------------------------------------------------------

Runs = Annotated[
    list[str] | None,
    typer.Argument(
        help="Run folders or URLs. Several runs of the same questions are compared. With --compare groups: "
        "NAME=RUN,RUN per group of models.",
        metavar="RUN…",
    ),
]
Compare = Annotated[
    str | None,
    typer.Option(
        "--compare",
        metavar="NAME|groups|vlm-vla|stages|steps",
        help="What is compared. NAME: every other run with this one; default: the first. groups: every two groups "
        "of models; groups=NAME: every other with this one. vlm-vla: VLM runs with policy runs. stages: VLM_RUN "
        "and RUN question by question: answer, probe, success. steps: checkpoints of a training, by the step in "
        "their folders; steps=N,N: by these steps.",
    ),
]
COMPARISONS = ("groups", "vlm-vla", "stages", "steps")


def read_comparison(text: str | None) -> tuple[str, str | None]:
    """Return the kind of comparison, `run` for that of runs, and what stands behind its `=`; the name of a run."""
    if text is None:
        return "run", None
    kind, separator, value = text.partition("=")
    if kind not in COMPARISONS:
        return "run", text
    if separator and (not value or kind in ("vlm-vla", "stages")):
        raise UsageError(f"--compare {text}: expected --compare {kind}{'=…' * (kind in ('groups', 'steps'))}")
    return kind, value or None


LabelTargets = Annotated[
    list[str] | None,
    typer.Option(
        "--target",
        metavar="COLUMN",
        help="Retention of a label of your own, by its column; repeat for several in one table. Default: of the "
        "side of the correct picture.",
        rich_help_panel=RUNS,
    ),
]
LabelFamily = Annotated[
    Family,
    typer.Option(
        "--family",
        help="With several --target, table corrects p for all of them (Holm).",
        rich_help_panel=RUNS,
    ),
]
ProbeKeys = Annotated[
    list[str] | None,
    typer.Option(
        "--probes",
        metavar="RUN=KEY",
        help="Probe results of a run; `probe-kit run show` lists them. Default: those requested last.",
        rich_help_panel=RUNS,
    ),
]
Views = Annotated[
    Names | None,
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
        help="Iterations of the action stream that count. best: layer curves show the best iteration only.",
        rich_help_panel=RUNS,
    ),
]
AbsentBelow = Annotated[
    float,
    typer.Option(
        "--absent-below",
        min=0.5,
        max=1.0,
        help="Accuracy below which a stream without signal is called absent.",
        rich_help_panel=RUNS,
    ),
]

# -- outcome rule ------------------------------------------------------------------------------------------------

Rule = Annotated[
    RuleName,
    typer.Option(
        "--rule", help="What counts as an answer. box: the released evaluation's.", rich_help_panel=RULES
    ),
]
LastSteps = Annotated[
    int,
    typer.Option(
        "--last-steps",
        min=1,
        help="Control steps at the end that are judged. The released evaluation averages 11.",
        rich_help_panel=RULES,
    ),
]
Epsilons = Annotated[
    Radii | None,
    typer.Option(
        "--epsilons",
        parser=Radii.parse,
        metavar="A,B,…",
        help="Zone radii in metres at which the rule disc is scored again, from stored positions.",
        rich_help_panel=RULES,
    ),
]

# -- VLM runs ----------------------------------------------------------------------------------------------------

Score = Annotated[
    AnswerScore,
    typer.Option("--score", help="How the answers of VLM runs are read.", rich_help_panel=VLM_RUNS),
]
SideWords = Annotated[
    bool,
    typer.Option(
        "--with-side-words", help="Count items such as 'no left turn sign' too.", rich_help_panel=VLM_RUNS
    ),
]

# -- output ------------------------------------------------------------------------------------------------------

Details = Annotated[
    Names,
    typer.Option(
        "--details",
        parser=some_of((*get_args(Section), "all")),
        metavar=f"{choices((*get_args(Section), 'all'))},…",
        help="Tables to print above the summary, comma-separated. all: every table, and every figure of "
        "--figures.",
    ),
]
NO_DETAILS = Names()
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
    typer.Option("--html", metavar="FILE", help="Write a report that needs no network."),
]
Figures = Annotated[
    Path | None,
    typer.Option(
        "--figures",
        metavar="FOLDER",
        help="Write the main figures as PNG and PDF; with --details all every figure.",
    ),
]
