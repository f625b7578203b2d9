"""`probe-kit stages`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit._terminal.console import out, print_json, say
from probe_kit.errors import NoProbesError, UsageError
from probe_kit.retention.commands import check_file

if TYPE_CHECKING:
    from probe_kit.retention.compare.known_used import KnownUsedTable


def stages(
    asked: Annotated[str, typer.Argument(help="A run of `probe-kit ask`.")],
    acted: Annotated[str, typer.Argument(help="A run of `probe-kit extract` in the same scenes.")],
    score: Annotated[str, typer.Option(help="Of the VLM run: text, logits, or order-balanced.")] = "text",
    view: Annotated[str | None, typer.Option(help="View of the policy run's probes; default the first.")] = None,
    probes: Annotated[str | None, typer.Option(help="Key of these probes; default those asked for last.")] = None,
    with_side_words: Annotated[
        bool, typer.Option("--with-side-words", help="Count items such as 'no left turn sign' too.")
    ] = False,
    wording: Annotated[
        str | None, typer.Option(help="Of a policy run with several wordings: which one; default its first.")
    ] = None,
    figures: Annotated[
        Path | None, typer.Option(help="Folder for the figure `known-used`, as PNG and PDF.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
) -> None:
    """Join what a model knows, what a policy encodes and what it does, question by question.

    known: the model answers right. encoded: the policy's probe reads it, better than chance and controls. used:
    the action follows. Refuses runs that did not begin with the same frames.
    """
    from probe_kit.extract import open_run
    from probe_kit.retention.behaviour.vlm_answers import scored
    from probe_kit.retention.columns.known_used_table import rich_known_used
    from probe_kit.retention.compare.known_used import match_runs
    from probe_kit.train import load_results

    reader = scored(open_run(asked), score, with_side_words)
    policy = open_run(acted).in_wording(wording)
    try:
        results = load_results(policy, probes)
    except NoProbesError:
        if view is not None:
            raise UsageError(f"--view {view}: {acted} has no probes. Run `probe-kit train {acted}`") from None
        results = None
    check_file(figures)
    joined = match_runs(reader, policy, results, view)
    if as_json:
        print_json(joined.to_json())
    else:
        out.print(rich_known_used(joined))
    if figures is not None:
        _save(joined, figures)


def _save(joined: "KnownUsedTable", folder: Path) -> None:
    from probe_kit.retention.displays.known_used import known_used_figures
    from probe_kit.retention.displays.report_figures import save_figures

    for path in save_figures(list(known_used_figures([joined])), folder):
        say(f"figure: {path}")
