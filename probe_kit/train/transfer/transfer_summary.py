"""A transfer for a terminal: a table of the best sites, and a sentence per view."""

from typing import TYPE_CHECKING

from probe_kit._system.counting import counted
from probe_kit._tables.numbers import p_text
from probe_kit._tables.table import Table
from probe_kit.hooks.contract.sites import label_of
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.best_sites import score_text
from probe_kit.train.transfer.transfer_results import TransferResults

if TYPE_CHECKING:
    import pandas as pd

_LEGEND = (
    "Fitted on one run, scored on the other. The score of a chosen site is too high. Chance: mean score with "
    "labels of the other run exchanged. Recentred: features of the other run moved to the mean of the first. "
    "Refitted: cross-validated probe of the other run itself"
)


def transfer_table(results: TransferResults, splits: bool = True) -> Table:
    """A row per stream and view for its best site."""
    several, metric = len(results.curves) > 1, METRICS[results.task]
    best = _best(results)
    rows = [(" · ".join([label_of(row["stream"]), *[row["view"]] * several]), *_cells(row)) for row in best]
    title = [f"{results.target}: {metric}", f"{results.model} to {results.other_model}"]
    title += ["OTHER WEIGHTS"] * (not results.same_weights)
    headings = (
        "stream",
        "best site",
        f"{metric} [95 %]",
        "chance",
        "family-wise p",
        "recentred",
        "refitted [95 %]",
    )
    overflow = "split" if splits else "leave out"
    return Table.of(", ".join(title), headings, rows, notes=[_LEGEND], overflow=overflow)


def transfer_sentences(results: TransferResults) -> list[str]:
    """Return a sentence per reason for leaving samples out, then one per view: where the label transfers."""
    sentences = [f"left out: {count} {reason}" for reason, count in results.left_out.items()]
    groups, samples = results.trained_on["groups"], results.trained_on["samples"]
    on = f"fitted on {counted(groups, 'group')}, {counted(samples, 'sample')}"
    for view in results.curves:
        rows = [row for row in _best(results) if row["view"] == view]
        of = f"{on}; scored on {counted(rows[0]['groups'], 'group')}, {counted(rows[0]['n'], 'sample')}"
        of += f", view {view}" if len(results.curves) > 1 else ""
        sentences.append(f"{results.target} ({of}) {'; '.join(map(_verdict, rows))}.")
    return sentences


def _best(results: TransferResults) -> "list[pd.Series]":
    """The row of `scores` of the best site of every view and stream: the largest excess over chance."""
    scores = results.scores
    excess = scores["score"] - scores["chance"].fillna(0.0)
    best = excess.groupby([scores["view"], scores["stream"]], sort=False).idxmax()
    return [scores.loc[number] for number in best]


def _cells(row: "pd.Series") -> tuple[str, ...]:
    return (
        str(row["site"]),
        f"{row['score']:.3f} [{row['ci_low']:.3f}, {row['ci_high']:.3f}]",
        score_text(row["chance"], is_side=False),
        p_text(row["p_fwe"]),
        score_text(row["recentred"], is_side=False),
        f"{row['refitted']:.3f} [{row['refitted_ci_low']:.3f}, {row['refitted_ci_high']:.3f}]",
    )


def _verdict(row: "pd.Series") -> str:
    where, numbers = (
        f"in the {label_of(row['stream'])}",
        f"({row['metric']} {row['score']:.2f}, refitted {row['refitted']:.2f})",
    )
    if row["p_fwe"] != row["p_fwe"]:
        return f"was not tested {where} {numbers}"
    if row["p_fwe"] < SIGNIFICANCE:
        return f"transfers {where} at {row['site']} {numbers}"
    return f"is not shown to transfer {where} {numbers}"
