"""`probe-kit retention`."""

from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from probe_kit._terminal.console import err, marked, out, print_json_text, print_text, say, split, whole_number
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from probe_kit.retention import RetentionTable
    from probe_kit.retention.estimators.retention import Iterations
    from probe_kit.train.data.run_reader import RunReader


ASKED = "VLM runs"


def retention(
    runs: Annotated[
        list[str] | None,
        typer.Argument(help="Run folders or URLs; of several on the same questions, differences are shown too."),
    ] = None,
    group: Annotated[
        list[str] | None, typer.Option(help="NAME=RUN,RUN: compare groups of runs, such as co-trained or not.")
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            help="Run (its folder or its name in tables) or group that every other is compared with; default: the "
            "first run against every other, every two groups."
        ),
    ] = None,
    style: Annotated[str, typer.Option("--format", help="table, json, csv, markdown or latex.")] = "table",
    probes: Annotated[
        list[str] | None,
        typer.Option(
            help="RUN=KEY: which probes of a run, as `run show` lists them; default those asked for last."
        ),
    ] = None,
    views: Annotated[str | None, typer.Option(help="Comma-separated; default all probed ones.")] = None,
    iterations: Annotated[
        str,
        typer.Option(
            help="Expert iterations or action tokens that count: all, last or a number. best: all, and layer "
            "curves show the best of each layer only."
        ),
    ] = "all",
    epsilons: Annotated[
        str | None, typer.Option(help="Zone radii in metres at which SR is scored again, from stored positions.")
    ] = None,
    wording: Annotated[
        str | None, typer.Option(help="Of runs with several wordings: the one tables are of; default their first.")
    ] = None,
    rule: Annotated[
        str,
        typer.Option(help="What counts as an answer: disc, box (the released evaluation's) or released-on-tile."),
    ] = "disc",
    last_steps: Annotated[
        int,
        typer.Option(help="Control steps at the end that are judged; the released evaluation averages 11."),
    ] = 1,
    html: Annotated[Path | None, typer.Option(help="File for a report to look at, without network.")] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for all figures, as PNG and PDF.")] = None,
    score: Annotated[
        str,
        typer.Option(help="Of VLM runs: text, logits, or order-balanced (no letter bias).", rich_help_panel=ASKED),
    ] = "text",
    vlm_vla: Annotated[
        bool,
        typer.Option("--vlm-vla", help="Test VLM − VLA: VLM runs against policy runs.", rich_help_panel=ASKED),
    ] = False,
    with_side_words: Annotated[
        bool,
        typer.Option(
            "--with-side-words", help="Count items such as 'no left turn sign' too.", rich_help_panel=ASKED
        ),
    ] = False,
    partial: Annotated[bool, typer.Option("--partial", help="Accept runs that are not finished.")] = False,
) -> None:
    """Print success rates and how much of the backbone's signal reaches the action expert."""
    from probe_kit.env.scoring.outcome import SENSITIVITY_RADII
    from probe_kit.env.scoring.rules import check_rule
    from probe_kit.extract import open_run
    from probe_kit.retention import retention_table as make_table
    from probe_kit.retention.behaviour.vlm_answers import scored
    from probe_kit.retention.rows.outcome_rules import check_epsilons

    check_epsilons(check_rule(rule), epsilons is not None)
    if last_steps < 1:
        raise UsageError(f"--last-steps {last_steps}: expected at least 1")
    if style not in _FORMATS:
        raise UsageError(f"unknown format {style!r}; expected one of {', '.join(_FORMATS)}")
    if bool(runs) == bool(group):
        raise UsageError("give run folders, or groups of them as --group NAME=RUN,RUN")
    grouped = _groups(group) if group else {"": tuple(runs or ())}
    _check_doubles([path for paths in grouped.values() for path in paths])
    steps = _iterations(iterations)
    radii = SENSITIVITY_RADII if epsilons is None else [_radius(part) for part in split(epsilons) or ()]
    _check_places(html, figures)
    opened = {
        name: [open_run(p, allow_partial=partial).in_wording(wording) for p in paths]
        for name, paths in grouped.items()
    }
    listed = [run for of_group in opened.values() for run in of_group]
    keys = _keys([path for paths in grouped.values() for path in paths], probes or [])
    table = make_table(
        opened if group else listed, split(views), iterations=steps, keys=keys, epsilons=radii, rule=rule,
        last_steps=last_steps,
        score=score, vlm_vla=vlm_vla, with_side_words=with_side_words, against=against,
    )  # fmt: skip
    if style == "table":
        out.print(table.to_rich())
    else:
        show = print_json_text if style == "json" else print_text
        show(getattr(table, f"to_{style}")())
        for note in table.notes:
            say(marked("[yellow]note:[/] {}", note))
    shown = [scored(run, score, with_side_words) for run in listed]
    if figures is not None:
        _save_figures(shown, table, figures)
    if html is not None:
        from probe_kit.extract.store.locations.disk import in_units
        from probe_kit.retention.report import write_report

        with err.status("drawing the report"):
            written = write_report(shown, html, table)
        say(f"report: {written} ({in_units(written.stat().st_size)})")


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


def _radius(text: str) -> float:
    try:
        radius = float(text)
    except ValueError:
        raise UsageError(f"{text!r} is not a number of metres") from None
    if not 0 < radius < inf:
        raise UsageError(f"a zone radius is {text} m; expected a positive number")
    return radius


def _iterations(text: str) -> "Iterations":
    if (number := whole_number(text)) is not None:
        return number
    if text not in ("all", "best", "last"):
        raise UsageError(f"iterations {text!r}; expected all, best, last or a number")
    return cast("Iterations", text)


_FORMATS = ("table", "json", "csv", "markdown", "latex")


def _save_figures(runs: "list[RunReader]", table: "RetentionTable", folder: Path) -> None:
    from probe_kit.retention.displays import collect_figures, save_figures

    for path in save_figures(collect_figures(runs, table), folder):
        say(f"figure: {path}")
