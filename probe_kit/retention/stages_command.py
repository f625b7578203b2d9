"""`probe-kit retention VLM_RUN RUN --compare stages`: answers of a VLM, probes and actions of a policy."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit._terminal.console import marked, out, print_json
from probe_kit.errors import NoProbesError, UsageError
from probe_kit.retention.output import save_all

if TYPE_CHECKING:
    from probe_kit.retention.choices import AnswerScore


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
    Acted: the cube ends on the correct picture. runs: the VLM's, then the policy's; both need the same first
    frames. views: at most one, of the policy run's probes; None for the first. key: of its probe results.
    Raises UsageError for other runs or views, and what `match_runs` raises.
    """
    from probe_kit.retention.behaviour.vlm_answers import scored
    from probe_kit.retention.columns.comparisons import known_used_tables
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
            out.print(marked("[yellow]{}[/]", note))
    if figures is not None:
        from probe_kit.retention.displays.known_used import known_used_figures

        save_all(list(known_used_figures([joined])), figures)
