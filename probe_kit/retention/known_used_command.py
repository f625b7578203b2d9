"""`probe-kit stages`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit._terminal import options as common
from probe_kit._terminal.console import out, print_json, say
from probe_kit.errors import NoProbesError, UsageError
from probe_kit.retention import command_options as own
from probe_kit.retention.commands import check_file

if TYPE_CHECKING:
    from probe_kit.retention.compare.known_used import KnownUsedTable


def stages(
    asked: Annotated[str, typer.Argument(help="Run of `probe-kit ask`.", metavar="VLM_RUN")],
    acted: Annotated[str, typer.Argument(help="Run of `probe-kit extract` in the same scenes.", metavar="RUN")],
    score: own.Score = "text",
    with_side_words: own.SideWords = False,
    view: Annotated[
        str | None,
        typer.Option(help="View of the policy run's probes. Default: the first.", rich_help_panel=own.RUNS),
    ] = None,
    probes: Annotated[
        str | None,
        typer.Option(help="Key of the probe results. Default: those requested last.", rich_help_panel=own.RUNS),
    ] = None,
    wording: common.Wording = None,
    figures: own.Figures = None,
    as_json: common.AsJson = False,
) -> None:
    """Compare what a VLM answers, a policy encodes and a policy does, question by question.

    Answered: the VLM answers right. Encoded: a probe of the policy reads the answer, above chance and controls.
    Acted: the cube ends on the correct picture. Both runs need the same first frames.
    """
    from probe_kit.extract import open_run
    from probe_kit.retention.behaviour.vlm_answers import scored
    from probe_kit.retention.columns.known_used_table import rich_known_used
    from probe_kit.retention.compare.known_used import match_runs
    from probe_kit.train import load_results

    vlm = scored(open_run(asked), score, with_side_words)
    policy = open_run(acted).in_wording(wording)
    try:
        results = load_results(policy, probes)
    except NoProbesError:
        if view is not None:
            raise UsageError(f"--view {view}: {acted} has no probes. Run `probe-kit train {acted}`") from None
        results = None
    check_file(figures)
    joined = match_runs(vlm, policy, results, view)
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
