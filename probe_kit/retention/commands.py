"""The command `probe-kit retention`, its output and its files."""

from collections.abc import Collection, Mapping, Sequence
from inspect import signature
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast, get_args

import typer

from probe_kit._system.counting import plural
from probe_kit._tables.printing import Format, print_table
from probe_kit._terminal import options as common
from probe_kit._terminal.console import (
    err,
    markup,
    out,
    print_json,
    print_text,
    say,
    say_note,
    split,
    whole_number,
)
from probe_kit._terminal.options import Names, choices, some_of
from probe_kit.errors import NoProbesError, UsageError
from probe_kit.retention.choices import AnswerScore, Family, Section
from probe_kit.scene_names import RuleName

if TYPE_CHECKING:
    from probe_kit.retention.choices import Iterations
    from probe_kit.retention.displays.report_figure import ReportFigure
    from probe_kit.retention.table import RetentionTable


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


def read_iterations(text: str) -> "Iterations":
    """Return `all`, `best`, `last` or a number.

    Raises:
        UsageError: For another text.
    """
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
        help="What to compare. NAME: this run with every other; default: the first run. groups: every two groups "
        "of models; groups=NAME: this group with every other. vlm-vla: VLM runs with policy runs. stages: "
        "VLM_RUN and RUN, question by question: answer, probe, success. steps: checkpoints of one training, "
        "ordered by the step in their folder names; steps=N,N: by these steps.",
    ),
]
COMPARISONS = ("groups", "vlm-vla", "stages", "steps")


def read_comparison(text: str | None) -> tuple[str, str | None]:
    """Return the kind of comparison, and the text after its `=`; of the kind `run`, the name of a run."""
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
    Radii | None,
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


# -- the command ---------------------------------------------------------------------------------------------

WITH_STAGES = ("runs", "probes", "views", "wording", "score", "with_side_words", "style", "figures")
WITH_TARGET = (
    "runs", "family", "probes", "views", "iterations", "wording", "partial", "details", "style", "html", "figures",
)  # fmt: skip
WITH_AS_PAPER = (
    "runs", "probes", "views", "iterations", "wording", "partial", "rule", "last_steps", "score",
    "with_side_words", "style",
)  # fmt: skip
WITH_STEPS = (
    "runs", "probes", "views", "iterations", "absent_below", "wording", "partial", "rule", "last_steps", "style",
    "figures",
)  # fmt: skip
"""Options of `retention` that go with another table than its own."""


def retention(
    runs: Runs = None,
    compare: Compare = None,
    target: LabelTargets = None,
    family: LabelFamily = "label",
    probes: ProbeKeys = None,
    views: Views = None,
    iterations: IterationChoice = "all",
    absent_below: AbsentBelow = 0.65,
    wording: common.Wording = None,
    partial: common.Partial = False,
    rule: Rule = "disc",
    last_steps: LastSteps = 1,
    epsilons: Epsilons = None,
    score: Score = "text",
    with_side_words: SideWords = False,
    details: Details = NO_DETAILS,
    as_paper: AsPaper = False,
    style: Format = "table",
    html: Html = None,
    figures: Figures = None,
) -> None:
    """Print success rates and how much of the backbone's signal reaches the action stream.

    With `--target COLUMN` the signal is that of a label of your own, see `probe-kit train --target COLUMN`.

    With `--compare stages` it compares a VLM and a policy question by question: answer, probe, success. Answer:
    the VLM answers right. Probe: a held-out probe of the policy is right. Success: the cube ends on the correct
    picture. Each in both layouts. Both runs need the same first frames.
    """
    values = locals()
    from probe_kit.env.scoring import SENSITIVITY_RADII
    from probe_kit.retention import retention_table as make_table
    from probe_kit.retention.behaviour import check_epsilons
    from probe_kit.retention.training_steps import read_steps
    from probe_kit.runs import open_run

    kind, runs_compared = read_comparison(compare)
    if kind == "stages":
        _check_only(values, WITH_STAGES, "compare", "--compare stages")
        common.check_no_others({f"--format {style}": style not in ("table", "json")}, "--compare stages")
        paths = list(runs or ())
        _check_doubles(paths)
        check_file(figures)
        key = _keys(paths, probes or [])[-1] if paths else None
        show_stages(paths, views, key, wording, score, with_side_words, style == "json", figures)
        return
    if target:
        _check_only(values, WITH_TARGET, "target", "labels of your own")
    elif family != "label":
        raise UsageError("--family is for labels of your own; give --target COLUMN too, or leave it out")
    if as_paper:
        _check_only(values, WITH_AS_PAPER, "as_paper", "the paper's own numbers (--as-paper)")
        common.check_no_others({f"--score {score}": score == "order-balanced"}, "--as-paper")
    if kind == "steps":
        _check_only(values, WITH_STEPS, "compare", "a table of training steps (--compare steps)")
    check_epsilons(rule, epsilons is not None)
    if not runs:
        raise UsageError("give run folders, or groups of them as --compare groups NAME=RUN,RUN NAME=RUN,RUN")
    grouped = _groups(runs) if kind == "groups" else {"": tuple(runs)}
    _check_doubles([path for paths in grouped.values() for path in paths])
    steps = read_iterations(iterations)
    if html is not None and html.is_dir():
        raise UsageError(f"--html {html} is a folder; give a file, such as {html / 'report.html'}")
    check_file(figures)
    opened = {
        name: [open_run(p, allow_partial=partial).in_wording(wording) for p in paths]
        for name, paths in grouped.items()
    }
    listed = [run for of_group in opened.values() for run in of_group]
    keys = _keys([path for paths in grouped.values() for path in paths], probes or [])
    if kind == "steps":
        training = read_steps(runs_compared, listed)
        order = sorted(range(len(listed)), key=lambda at: training[str(listed[at].location)])
        listed, keys = [listed[at] for at in order], [keys[at] for at in order]
    table = make_table(
        opened if kind == "groups" else listed, views, iterations=steps, keys=keys,
        epsilons=epsilons or SENSITIVITY_RADII, rule=rule, last_steps=last_steps, absent_below=absent_below,
        score=score, vlm_vla=kind == "vlm-vla", with_side_words=with_side_words,
        against=runs_compared if kind in ("run", "groups") else None, target=target or None, family=family,
    )  # fmt: skip
    if as_paper:
        print_table(table.as_paper, style, table.notes)
    elif kind == "steps":
        _show_steps(table, training, style, figures)
    else:
        if figures is not None:
            from probe_kit.retention.displays import collect_figures

            save_all(collect_figures(listed, table), figures, "all" in details)
        if html is not None:
            from probe_kit.retention.report import write_report

            with err.status("drawing the report"):
                written = write_report(listed, html, table)
            say_report(written)
        _print_sections(table, style, details)


def _print_sections(table: "RetentionTable", style: str, details: Sequence[str]) -> None:
    """Print the table in a format, with the sections that were requested where the format has any."""
    sections: Collection[Section] | Literal["all"]
    sections = "all" if "all" in details else cast("tuple[Section, ...]", details)
    if style == "table":
        out.print(table.to_rich(sections))
    elif style in ("json", "csv", "markdown"):  # Markdown has every table
        print_table(table, style, table.notes)
    else:
        print_text(table.to_latex(sections) if style == "latex" else table.to_text(style, sections))
        for note in table.notes:
            say_note(note)


def _show_steps(table: "RetentionTable", training: Mapping[str, int], style: str, figures: Path | None) -> None:
    """Print the table over training steps, and draw its figure.

    Args:
        table: The retention table of all checkpoints.
        training: Steps by the location of a run.
        style: Format of the printed table.
        figures: Folder of the figure; None for no figure.
    """
    from probe_kit.retention.displays.display import ProvenanceLine
    from probe_kit.retention.training_steps import step_table, training_step_figure

    by_step = step_table(table, training)
    if figures is not None:
        lines = [ProvenanceLine.of_row(mean) for mean in table.means]
        save_all([training_step_figure(by_step, lines)], figures)
    print_table(by_step, style, (*table.unpaired, *table.notes))


def _check_only(values: Mapping[str, object], allowed: Collection[str], option: str, table: str) -> None:
    """Raise UsageError for an option of `retention` that differs from its default and does not go with a table.

    Args:
        values: The value of every parameter.
        allowed: Parameters that go with the table.
        option: The parameter that requests the table.
        table: Name of the table in messages.
    """
    are_set = {
        f"--{'format' if name == 'style' else name.replace('_', '-')}": values[name] != parameter.default
        for name, parameter in signature(retention).parameters.items()
        if name not in (*allowed, option)
    }
    common.check_no_others(are_set, table)


def check_file(figures: Path | None) -> None:
    """Raise UsageError if figures should go to a path that is a file."""
    if figures is not None and figures.exists() and not figures.is_dir():
        raise UsageError(f"--figures {figures} is a file; give a folder")


def _keys(paths: list[str], texts: list[str]) -> list[str | None]:
    """Return the key of every run in order, None where none was chosen.

    A run goes by its path or its folder's name.
    """
    keys: list[str | None] = [None] * len(paths)
    for text in texts:
        name, separator, key = text.rpartition("=")
        if not (separator and name and key):
            raise UsageError(f"--probes {text!r} is not RUN=KEY; `probe-kit run show RUN` lists the keys")
        matches = [at for at, path in enumerate(paths) if _strip_name(path) == _strip_name(name)]
        matches = matches or [at for at, path in enumerate(paths) if _strip_name(path).rpartition("/")[2] == name]
        if len(matches) != 1:
            raise UsageError(
                f"--probes {text!r}: {name} is {'several' if matches else 'none'} of the runs {', '.join(paths)}"
            )
        if keys[matches[0]] is not None:
            raise UsageError(f"--probes chooses probes of {name} twice; choose one")
        keys[matches[0]] = key
    return keys


def _strip_name(path: str) -> str:
    return path.rstrip("/") if "://" in path else str(Path(path).resolve())


def _check_doubles(paths: Sequence[str]) -> None:
    """Raise UsageError for a path that is given twice, before anything is opened.

    The function `retention` also knows copies of a run.
    """
    for at, path in enumerate(paths):
        if _strip_name(path) in map(_strip_name, paths[:at]):
            raise UsageError(f"{path} is given twice; its episodes would count twice. Leave one out")


def _groups(texts: Sequence[str]) -> dict[str, tuple[str, ...]]:
    groups = {}
    for text in texts:
        name, separator, paths = text.partition("=")
        if not (separator and name and split(paths)):
            raise UsageError(f"{text!r} is not NAME=RUN,RUN, a group of models")
        if name in groups:
            raise UsageError(f"the group {name!r} is given twice; write all of its runs after one {name}=")
        groups[name] = tuple(filter(None, map(str.strip, paths.split(","))))  # a run given twice is refused
    return groups


def save_all(figures: "Sequence[ReportFigure]", folder: Path, details: bool = False) -> None:
    """Draw the main figures into a folder, and print where each is and how many are left out.

    Args:
        figures: All figures of a table.
        folder: Folder of the figures.
        details: Whether every figure is drawn.
    """
    from probe_kit.retention.displays import save_figures

    drawn = [report_figure for report_figure in figures if details or not report_figure.is_detail]
    for path in save_figures(drawn, folder):
        say(f"figure: {path}")
    if left_out := len(figures) - len(drawn):
        say(f"{plural(left_out, 'further figure')}: add --details all")


def say_report(written: Path) -> None:
    """Print where a report is, and its size."""
    from probe_kit.runs.run_folders import in_units

    say(f"report: {written} ({in_units(written.stat().st_size)})")


def show_stages(
    runs: Sequence[str],
    views: Sequence[str] | None,
    key: str | None,
    wording: str | None,
    score: "AnswerScore",
    with_side_words: bool,
    as_json: bool,
    figures: Path | None,
) -> None:
    """Compare what a VLM answers, a policy encodes and a policy does, question by question.

    Answered: the VLM answers right. Encoded: a probe of the policy reads the answer, above chance and controls.
    Acted: the cube ends on the correct picture. Raises as `match_runs` too.

    Args:
        runs: The VLM's, then the policy's; both need the same first frames.
        views: At most one, of the policy run's probes; None for the first.
        key: Key of the policy's probe results; None for the default.
        wording: The wording of the policy run; None for the default.
        score: The score by which the VLM's answers are read.
        with_side_words: Whether items in whose name a side stands are counted.
        as_json: Whether JSON is printed instead of tables.
        figures: Folder of the figures; None for no figure.

    Raises:
        UsageError: For other runs or views.
    """
    from probe_kit.retention.behaviour import scored
    from probe_kit.retention.columns.tables import known_used_tables
    from probe_kit.retention.compare.known_used import match_runs
    from probe_kit.runs import open_run
    from probe_kit.train.results.store import load_side_results

    if len(runs) != 2:
        raise UsageError(f"--compare stages compares two runs, and {len(runs)} are given; expected VLM_RUN RUN")
    if views is not None and len(views) != 1:
        raise UsageError(
            f"--compare stages reads probes of one view; --views {','.join(views)} has {len(views)}. Give one"
        )
    view = views[0] if views else None
    vlm = scored(open_run(runs[0]), score, with_side_words)
    policy = open_run(runs[1]).in_wording(wording)
    try:
        results = load_side_results(policy, key)
    except NoProbesError as error:
        if view is not None:
            raise UsageError(f"--views {view}: {error}") from None
        results = None
    joined = match_runs(vlm, policy, results, view)
    if as_json:
        print_json(joined.to_json())
    else:
        for table in known_used_tables(joined):
            out.print(table)
        for note in joined.notes:
            out.print(markup("[yellow]{}[/]", note))
    if figures is not None:
        from probe_kit.retention.displays.bars import known_used_figure

        save_all([known_used_figure(joined)], figures)
