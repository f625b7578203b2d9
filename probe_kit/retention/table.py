"""The retention table: several runs joined, and the ways to write it down."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from probe_kit.errors import NoProbesError
from probe_kit.retention.measure import Iterations
from probe_kit.retention.rows import RetentionRow, mean_row, run_rows
from probe_kit.train.reader import RunReader
from probe_kit.train.results import ProbeResults
from probe_kit.train.store import load_results

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Group


@dataclass(frozen=True)
class RetentionTable:
    """Rows per run, category and view, and per run and view their category mean.

    Runs are never averaged with each other, so no mean mixes suites.
    """

    rows: list[RetentionRow]
    means: list[RetentionRow]

    @property
    def all_rows(self) -> list[RetentionRow]:
        """Category rows of each run and view, each followed by its mean."""
        return [
            row
            for mean in self.means
            for row in [*(row for row in self.rows if (row.run, row.view) == (mean.run, mean.view)), mean]
        ]

    def to_frame(self) -> "pd.DataFrame":
        """All rows as a data frame with the fields of `RetentionRow`.

        Intervals become two columns, `sr_ci_low` and so on, and lists of categories become text.
        """
        import pandas as pd

        frame = pd.DataFrame([asdict(row) for row in self.all_rows])
        for name in ("sr_ci", "retention_ci"):
            limits = frame.pop(name)
            frame[f"{name}_low"] = [None if pair is None else pair[0] for pair in limits]
            frame[f"{name}_high"] = [None if pair is None else pair[1] for pair in limits]
        for name in ("categories", "left_out"):
            frame[name] = frame[name].map(" ".join)
        return frame.convert_dtypes()

    def to_json(self) -> str:
        """All rows as a JSON list of objects; the keys are the fields of `RetentionRow`."""
        return json.dumps([asdict(row) for row in self.all_rows], indent=2, ensure_ascii=False, allow_nan=False)

    def to_csv(self) -> str:
        """All rows as comma-separated values with a header."""
        return self.to_frame().to_csv(index=False)

    def to_markdown(self) -> str:
        """Success rates and retention as two Markdown tables."""
        from probe_kit.retention.markdown import markdown

        return markdown(self.all_rows)

    def to_latex(self) -> str:
        """The retention table in LaTeX, with booktabs rules and five heat colours."""
        from probe_kit.retention.latex import latex

        return latex(self.all_rows)

    def to_rich(self) -> "Group":
        """Success rates and retention as two tables for a rich console."""
        from probe_kit.retention.console import rich_tables

        return rich_tables(self.all_rows)


def retention(
    runs: Sequence[RunReader],
    views: Sequence[str] | None = None,
    *,
    iterations: Iterations = "all",
    keys: Sequence[str | None] | None = None,
    seed: int = 0,
) -> RetentionTable:
    """Success rates, probe peaks and retention of several runs, per category and view.

    views: those that were probed by default. iterations: which expert iterations take part. keys: which stored
    probe results of each run to use, the newest by default. A run without activations or probes shows success
    rates only. Raises UnknownSiteError for a view that was not probed and UsageError for an unknown key.
    """
    rows: list[RetentionRow] = []
    means: list[RetentionRow] = []
    for run, key in zip(runs, keys or [None] * len(runs), strict=True):
        found = run_rows(run, _results(run, key), views, iterations, seed)
        rows += found
        means += [
            mean_row([row for row in found if row.view == view]) for view in dict.fromkeys(r.view for r in found)
        ]
    return RetentionTable(rows, means)


def _results(run: RunReader, key: str | None) -> ProbeResults | None:
    try:
        return load_results(run, key)
    except NoProbesError:
        return None
