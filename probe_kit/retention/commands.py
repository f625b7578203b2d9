"""`probe-kit retention`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from probe_kit._terminal import options as common
from probe_kit._terminal.console import err, marked, out, print_json_text, print_text, say, split
from probe_kit.errors import UsageError
from probe_kit.retention import command_options as own
from probe_kit.retention.label_commands import save_all, say_report

if TYPE_CHECKING:
    from probe_kit.retention.choices import Section, TableFormat
    from probe_kit.retention.formats.as_paper import PaperTable
    from probe_kit.retention.table import RetentionTable


def retention(
    runs: own.Runs = None,
    group: own.Groups = None,
    against: own.Against = None,
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
    vlm_vla: own.VlmVla = False,
    with_side_words: own.SideWords = False,
    details: own.Details = own.NO_DETAILS,
    as_paper: own.AsPaper = False,
    style: own.Style = "table",
    html: own.Html = None,
    figures: own.Figures = None,
) -> None:
    """Print success rates and how much of the backbone's signal reaches the action stream.

    With `--target COLUMN` the signal is that of a label of your own, see `probe-kit train --target COLUMN`.
    """
    from probe_kit.env.scoring.outcome import SENSITIVITY_RADII
    from probe_kit.extract import open_run
    from probe_kit.retention import retention_table as make_table
    from probe_kit.retention.behaviour.vlm_answers import scored
    from probe_kit.retention.label_commands import show_label_retention
    from probe_kit.retention.labels.table import label_retention_table
    from probe_kit.retention.rows.outcome_rules import check_epsilons

    if target:
        refused = {
            "--group": group, "--against": against, "--rule": rule != "disc", "--last-steps": last_steps != 1,
            "--epsilons": epsilons, "--score": score != "text", "--vlm-vla": vlm_vla,
            "--with-side-words": with_side_words, "--details": details, "--absent-below": absent_below != 0.65,
            "--as-paper": as_paper,
        }  # fmt: skip
        common.check_no_others(refused)
        if not runs:
            raise UsageError("give run folders whose probes of a label are stored")
        _check_doubles(runs)
        _check_places(html, figures)
        opened_runs = [open_run(p, allow_partial=partial).in_wording(wording) for p in runs]
        labels = label_retention_table(
            opened_runs, target, views, iterations=own.read_iterations(iterations),
            keys=_keys(runs, probes or []), family=family,
        )  # fmt: skip
        show_label_retention(opened_runs, labels, style, html, figures)
        return
    if family != "label":
        raise UsageError("--family is for labels of your own; give --target COLUMN too, or leave it out")
    if as_paper:
        refused = {
            "--group": group, "--against": against, "--epsilons": epsilons, "--absent-below": absent_below != 0.65,
            "--score order-balanced": score == "order-balanced", "--vlm-vla": vlm_vla, "--details": details,
            "--html": html is not None, "--figures": figures is not None,
        }  # fmt: skip
        common.check_no_others(refused, "the paper's own numbers (--as-paper)")
    check_epsilons(rule, epsilons is not None)
    if bool(runs) == bool(group):
        raise UsageError("give run folders, or groups of them as --group NAME=RUN,RUN")
    grouped = _groups(group) if group else {"": tuple(runs or ())}
    _check_doubles([path for paths in grouped.values() for path in paths])
    steps = own.read_iterations(iterations)
    _check_places(html, figures)
    opened = {
        name: [open_run(p, allow_partial=partial).in_wording(wording) for p in paths]
        for name, paths in grouped.items()
    }
    listed = [run for of_group in opened.values() for run in of_group]
    keys = _keys([path for paths in grouped.values() for path in paths], probes or [])
    table = make_table(
        opened if group else listed, views, iterations=steps, keys=keys, epsilons=epsilons or SENSITIVITY_RADII,
        rule=rule, last_steps=last_steps, absent_below=absent_below, score=score, vlm_vla=vlm_vla,
        with_side_words=with_side_words, against=against,
    )  # fmt: skip
    if as_paper:
        _print(table.as_paper, style, table.notes)
        return
    shown = [scored(run, score, with_side_words) for run in listed]
    if figures is not None:
        from probe_kit.retention.displays import collect_figures

        save_all(collect_figures(shown, table), figures)
    if html is not None:
        from probe_kit.retention.report import write_report

        with err.status("drawing the report"):
            written = write_report(shown, html, table)
        say_report(written)
    if style == "table":
        out.print(table.to_rich("all" if "all" in details else cast("tuple[Section, ...]", details)))
    else:
        _print(table, style, table.notes)


def _print(table: "RetentionTable | PaperTable", style: "TableFormat", notes: Sequence[str]) -> None:
    """Print a table in a format, and its notes beside it, where a program does not read them."""
    if style == "table":
        out.print(table.to_rich())
    else:
        show = print_json_text if style == "json" else print_text
        show(getattr(table, f"to_{style}")())
    for note in notes:
        say(marked("[yellow]note:[/] {}", note))


def _check_places(html: Path | None, figures: Path | None) -> None:
    """Refuse places that cannot be written to before anything is computed."""
    if html is not None and html.is_dir():
        raise UsageError(f"--html {html} is a folder; give a file, such as {html / 'report.html'}")
    check_file(figures)


def check_file(figures: Path | None) -> None:
    """Raise UsageError if figures should go to what is a file."""
    if figures is not None and figures.exists() and not figures.is_dir():
        raise UsageError(f"--figures {figures} is a file; give a folder")


def _keys(paths: list[str], chosen: list[str]) -> list[str | None]:
    """The key of every run in order, None where none was chosen; a run goes by its path or its folder's name."""
    keys: list[str | None] = [None] * len(paths)
    for text in chosen:
        name, separator, key = text.rpartition("=")
        if not (separator and name and key):
            raise UsageError(f"--probes {text!r} is not RUN=KEY; `probe-kit run show RUN` lists the keys")
        found = [at for at, path in enumerate(paths) if _place(path) == _place(name)]
        found = found or [at for at, path in enumerate(paths) if _place(path).rpartition("/")[2] == name]
        if len(found) != 1:
            raise UsageError(
                f"--probes {text!r}: {name} is {'several' if found else 'none'} of the runs {', '.join(paths)}"
            )
        if keys[found[0]] is not None:
            raise UsageError(f"--probes chooses probes of {name} twice; choose one")
        keys[found[0]] = key
    return keys


def _place(path: str) -> str:
    return path.rstrip("/") if "://" in path else str(Path(path).resolve())


def _check_doubles(paths: Sequence[str]) -> None:
    """Said before anything is opened; `retention` also knows copies of a run."""
    for at, path in enumerate(paths):
        if _place(path) in map(_place, paths[:at]):
            raise UsageError(f"{path} is given twice; its episodes would count twice. Leave one out")


def _groups(texts: list[str]) -> dict[str, tuple[str, ...]]:
    groups = {}
    for text in texts:
        name, separator, paths = text.partition("=")
        if not (separator and name and split(paths)):
            raise UsageError(f"--group {text!r} is not NAME=RUN,RUN")
        if name in groups:
            raise UsageError(f"--group {name!r} is given twice; write all of its runs after one {name}=")
        groups[name] = tuple(filter(None, map(str.strip, paths.split(","))))  # a run given twice is refused
    return groups
