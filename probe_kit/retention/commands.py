"""`probe-kit retention`."""

from collections.abc import Collection, Mapping, Sequence
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

from probe_kit._tables.printing import Format, print_table
from probe_kit._terminal import options as common
from probe_kit._terminal.console import err, out, print_text, say_note, split
from probe_kit.errors import UsageError
from probe_kit.retention import command_options as own
from probe_kit.retention.output import save_all, say_report

if TYPE_CHECKING:
    from probe_kit.retention.choices import Section
    from probe_kit.retention.table import RetentionTable
    from probe_kit.runs.reader import RunReader

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
    runs: own.Runs = None,
    compare: own.Compare = None,
    target: own.LabelTargets = None,
    family: own.LabelFamily = "label",
    probes: own.ProbeKeys = None,
    views: own.Views = None,
    iterations: own.IterationChoice = "all",
    absent_below: own.AbsentBelow = 0.65,
    wording: common.Wording = None,
    partial: common.Partial = False,
    rule: own.Rule = "disc",
    last_steps: own.LastSteps = 1,
    epsilons: own.Epsilons = None,
    score: own.Score = "text",
    with_side_words: own.SideWords = False,
    details: own.Details = own.NO_DETAILS,
    as_paper: own.AsPaper = False,
    style: Format = "table",
    html: own.Html = None,
    figures: own.Figures = None,
) -> None:
    """Print success rates and how much of the backbone's signal reaches the action stream.

    With `--target COLUMN` the signal is that of a label of your own, see `probe-kit train --target COLUMN`.

    With `--compare stages` it compares a VLM and a policy question by question: answer, probe, success. Answer:
    the VLM answers right. Probe: a held-out probe of the policy is right. Success: the cube ends on the correct
    picture. Each in both layouts. Both runs need the same first frames.
    """
    values = locals()
    from probe_kit.env.scoring.outcome import SENSITIVITY_RADII
    from probe_kit.retention import retention_table as make_table
    from probe_kit.retention.behaviour.vlm_answers import scored
    from probe_kit.retention.rows.outcome_rules import check_epsilons
    from probe_kit.retention.stages_command import show_stages
    from probe_kit.retention.training_steps import read_steps
    from probe_kit.runs import open_run

    kind, runs_compared = own.read_comparison(compare)
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
    steps = own.read_iterations(iterations)
    _check_places(html, figures)
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
        scored_runs = listed if target else [scored(run, score, with_side_words) for run in listed]
        _write_files(scored_runs, table, figures, html, "all" in details)
        _print_sections(table, style, details)


def _write_files(
    runs: "Sequence[RunReader]",
    table: "RetentionTable",
    figures: Path | None,
    html: Path | None,
    every_figure: bool,
) -> None:
    """Draw the figures into a folder and the report into a file, each where it is asked for."""
    if figures is not None:
        from probe_kit.retention.displays import collect_figures

        save_all(collect_figures(runs, table), figures, every_figure)
    if html is not None:
        from probe_kit.retention.report import write_report

        with err.status("drawing the report"):
            written = write_report(runs, html, table)
        say_report(written)


def _print_sections(table: "RetentionTable", style: str, details: Sequence[str]) -> None:
    """Print the table in a format, with the sections that are asked for where the format has any."""
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
    """Print the table over training steps, and draw its figure. training: steps by the location of a run."""
    from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
    from probe_kit.retention.displays.training_steps import training_step_figure
    from probe_kit.retention.training_steps import step_table

    by_step = step_table(table, training)
    if figures is not None:
        lines = [ProvenanceLine.of_row(mean) for mean in table.means]
        save_all([training_step_figure(by_step, lines)], figures)
    print_table(by_step, style, (*table.unpaired, *table.notes))


def _check_only(values: Mapping[str, object], allowed: Collection[str], option: str, table: str) -> None:
    """Raise UsageError for an option of `retention` that differs from its default and does not go with a table.

    values: the value of every parameter. allowed: what goes with it. option: the one that asks for the table.
    table: what it is called.
    """
    are_set = {
        f"--{'format' if name == 'style' else name.replace('_', '-')}": values[name] != parameter.default
        for name, parameter in signature(retention).parameters.items()
        if name not in (*allowed, option)
    }
    common.check_no_others(are_set, table)


def _check_places(html: Path | None, figures: Path | None) -> None:
    """Refuse places that cannot be written to before anything is computed."""
    if html is not None and html.is_dir():
        raise UsageError(f"--html {html} is a folder; give a file, such as {html / 'report.html'}")
    check_file(figures)


def check_file(figures: Path | None) -> None:
    """Raise UsageError if figures should go to what is a file."""
    if figures is not None and figures.exists() and not figures.is_dir():
        raise UsageError(f"--figures {figures} is a file; give a folder")


def _keys(paths: list[str], texts: list[str]) -> list[str | None]:
    """The key of every run in order, None where none was chosen; a run goes by its path or its folder's name."""
    keys: list[str | None] = [None] * len(paths)
    for text in texts:
        name, separator, key = text.rpartition("=")
        if not (separator and name and key):
            raise UsageError(f"--probes {text!r} is not RUN=KEY; `probe-kit run show RUN` lists the keys")
        matches = [at for at, path in enumerate(paths) if _stripped(path) == _stripped(name)]
        matches = matches or [at for at, path in enumerate(paths) if _stripped(path).rpartition("/")[2] == name]
        if len(matches) != 1:
            raise UsageError(
                f"--probes {text!r}: {name} is {'several' if matches else 'none'} of the runs {', '.join(paths)}"
            )
        if keys[matches[0]] is not None:
            raise UsageError(f"--probes chooses probes of {name} twice; choose one")
        keys[matches[0]] = key
    return keys


def _stripped(path: str) -> str:
    return path.rstrip("/") if "://" in path else str(Path(path).resolve())


def _check_doubles(paths: Sequence[str]) -> None:
    """Said before anything is opened; `retention` also knows copies of a run."""
    for at, path in enumerate(paths):
        if _stripped(path) in map(_stripped, paths[:at]):
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
