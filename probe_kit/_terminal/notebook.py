"""Notebook display: a small table of facts per object, and a progress bar that needs no widget."""

import sys
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import Any

from probe_kit._system.escaping import without_folders

PROGRESS_MARK = "probe-kit-progress"
"""The CSS class of a progress bar, so that a tool that stores notebooks can remove the bars."""
_REDRAW_S = 0.2


def facts_html(title: str, facts: Mapping[str, str], note: str = "") -> str:
    """Return a bold title, a line per fact, and a note below; legible on light and dark pages."""
    lines = "".join(
        f'<tr><td style="text-align:left;opacity:.65">{_safe(name)}</td>'
        f'<td style="text-align:left">{_safe(value)}</td></tr>'
        for name, value in facts.items()
        if value
    )
    below = f'<div style="opacity:.65">{_safe(note)}</div>' if note else ""
    return f"<div><b>{_safe(title)}</b><table>{lines}</table>{below}</div>"


def rows_html(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], note: str = "") -> str:
    """Return a bold title over a table with a heading per column, and a note below."""
    head = "".join(f'<th style="text-align:left">{_safe(name)}</th>' for name in columns)
    body = "".join(
        "<tr>" + "".join(f'<td style="text-align:left">{_safe(str(value))}</td>' for value in row) + "</tr>"
        for row in rows
    )
    below = f'<div style="opacity:.65">{_safe(note)}</div>' if note else ""
    return f"<div><b>{_safe(title)}</b><table><tr>{head}</tr>{body}</table>{below}</div>"


def _safe(text: str) -> str:
    """Escape for HTML, and leave out the folders of this machine: notebooks are sent to others."""
    return escape(without_folders(text))


def notebook_progress(label: str) -> Callable[..., None] | None:
    """Return a callback (done, total, …) that draws one progress bar below the cell; None outside notebooks."""
    return _Bar(label) if _in_notebook() else None


def ignore_absent_widgets() -> None:
    """Keep tqdm's warning that ipywidgets is not installed out of notebooks.

    tqdm warns as soon as transformers, datasets or huggingface_hub is imported in a kernel. The bars of probe_kit
    need no widget, and tqdm's own are then plain text.
    """
    if "ipykernel" in sys.modules:
        warnings.filterwarnings("ignore", message="IProgress not found")


def _in_notebook() -> bool:
    """Whether a notebook's kernel runs this process, so that rich output is displayed."""
    if "ipykernel" not in sys.modules:
        return False
    from IPython import get_ipython

    return getattr(get_ipython(), "kernel", None) is not None


class _Bar:
    """Plain HTML that is replaced in place, which every front end supports; drawn at the first call."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._started = time.monotonic()
        self._drawn = 0.0
        self._handle: Any = None

    def __call__(self, finished: int, total: int, *_: object) -> None:
        now = time.monotonic()
        if self._handle is not None and finished < total and now - self._drawn < _REDRAW_S:
            return
        self._drawn = now
        from IPython.display import display

        picture = _Drawn(self._label, finished, total, now - self._started)
        if self._handle is None:
            self._handle = display(picture, display_id=True)  # type: ignore[no-untyped-call]
        else:
            self._handle.update(picture)


class _Drawn:
    def __init__(self, label: str, finished: int, total: int, seconds: float) -> None:
        remaining = f", about {seconds * (total - finished) / finished:.0f} s left" if 0 < finished < total else ""
        self._text = f"{label}: {finished} of {total}, {seconds:.0f} s{remaining}"
        self._done, self._total = finished, total

    def __repr__(self) -> str:
        # A stored notebook holds results: of a bar at its end it keeps no text, and no time of this machine.
        return self._text if self._done < self._total else ""

    def _repr_html_(self) -> str:
        bar = f'<progress value="{self._done}" max="{self._total}" style="width:16em"></progress>'
        return f'<div class="{PROGRESS_MARK}">{bar} {escape(self._text)}</div>'
