"""The table of `probe-kit run show --action-errors`: predicted against recorded actions."""

from typing import TYPE_CHECKING, Any

from probe_kit._terminal.console import out, print_json
from probe_kit._terminal.plain_text import terminal_safe

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.runs.action_errors import ActionErrors


def show_action_errors(run: str, partial: bool, as_json: bool) -> None:
    """Print how the actions that a model predicted differ from the recorded ones.

    Errors are in standard deviations of the recorded actions at the shown frames: the mean recorded action has an
    error of 1. as_json: print every episode too. Raises what `compare_actions` raises.
    """
    from probe_kit.runs import compare_actions, open_run

    errors = compare_actions(open_run(run, allow_partial=partial))
    if as_json:
        print_json({"run": run, "numbers": _plain(errors.by_number), "episodes": _plain(errors.by_episode)})
    else:
        _print_errors(errors)


def _plain(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """The lines of a frame as JSON has them: NaN is null."""
    rows = frame.to_dict("records")
    return [{str(name): None if value != value else value for name, value in row.items()} for row in rows]


def _print_errors(errors: "ActionErrors") -> None:
    """A line per number of an action, and how the episodes differ."""
    from rich.table import Table

    episodes = errors.by_episode
    table = Table(title=f"predicted against recorded actions, {int(episodes['frames'].sum())} frames")
    for heading in ("number", "recorded deviation", "bias", "error, first action", "error, whole chunk"):
        table.add_column(heading, justify="left" if heading == "number" else "right")
    for row in _plain(errors.by_number):
        errors_of_number = [row["bias"], row["first"], row["chunk"]]
        cells = ["constant" if error is None else f"{error:.2f}" for error in errors_of_number]
        table.add_row(terminal_safe(row["number"]), f"{row['deviation']:.3g}", *cells)
    out.print(table)
    ordered = _plain(episodes.sort_values("first").dropna())
    span = [f"{row['first']:.2f} in episode {row['source_episode']}" for row in (ordered[:1] + ordered[-1:])]
    out.print(
        "bias and errors in recorded deviations; the mean recorded action has 1. First action: "
        f"{' to '.join(span) or 'nothing recorded'}",
        soft_wrap=True,
    )
