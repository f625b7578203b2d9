"""Tables in LaTeX: booktabs rules, five heat colors, and no tabular wider than its line."""

import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import cast

from probe_kit._tables.content import HEAT, Cell, Content

_GREEK = {
    "α": "alpha", "β": "beta", "γ": "gamma", "δ": "delta", "ε": "epsilon", "θ": "theta", "λ": "lambda", "μ": "mu",
    "π": "pi", "ρ": "rho", "σ": "sigma", "τ": "tau", "φ": "phi", "ψ": "psi", "ω": "omega", "Δ": "Delta",
}  # fmt: skip
_SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "–": "--",
    "−": "$-$",
    "<": "$<$",
    ">": "$>$",
    "|": r"\textbar{}",
    "×": r"$\times$",
    "·": r"$\cdot$",
    "✓": r"$^{*}$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "→": r"$\rightarrow$",
    "\0": "{}",
    "\n": " ",
    "\r": " ",
    **{letter: f"$\\{name}$" for letter, name in _GREEK.items()},
}
MOST_COLUMNS = 13
"""The most columns of a tabular; a wider table becomes several, one below the other, each with the row names."""
_FITTED = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"
"""The command before a tabular: one that is wider than its line becomes as wide as it."""


def _preamble(tables: Sequence[Content]) -> str:
    """Return the packages that the tables need as a comment, and their colors."""
    coloured = any(_css(cell) for table in tables for row in table.rows for cell in row.cells)
    needs = r"% needs: \usepackage{booktabs} \usepackage{graphicx}"
    if not coloured:
        return needs
    colours = [rf"\definecolor{{{name}}}{{HTML}}{{{rgb}}}" for _, name, rgb in HEAT]
    return "\n".join([rf"{needs} \usepackage[table]{{xcolor}}", *colours])


def render(tables: Sequence[Content], sentences: Sequence[str] = (), notes: Sequence[str] = ()) -> str:
    """Return the tables behind their preamble, each with its own label; sentences and notes are comments."""
    texts: list[str] = []
    labels: dict[str, int] = {}
    for table in tables:
        text = _environment(table)
        label = _label(table)
        labels[label] = labels.get(label, 0) + 1
        again = f"{label}-{labels[label]}" if labels[label] > 1 else label
        texts.append(text.replace(rf"\label{{{label}}}", rf"\label{{{again}}}"))
    comments = [f"% {' '.join(line.split())}" for line in (*sentences, *notes)]
    return "\n".join([_preamble(tables), *texts, *comments])


def _environment(table: Content) -> str:
    """Return a `table` environment with a caption and a label; it needs the packages booktabs and graphicx."""
    pieces = [piece for part in _parts(table) for piece in (r"\par\medskip", *_tabular(part))][1:]
    caption = " ".join([f"{table.title}.", *table.sentences])
    head = [r"\begin{table}", r"\centering", rf"\caption{{{escape(caption)}}}", rf"\label{{{_label(table)}}}"]
    return "\n".join([*head, *pieces, r"\end{table}", ""])


def escape(text: str) -> str:
    """Return `text` with LaTeX's special characters made harmless."""
    apart = re.sub("-(?=-)", "-\0", text)  # two hyphens would become one dash
    return "".join(_SPECIAL.get(character, character) for character in apart)


def _label(table: Content) -> str:
    words = re.sub(r"[^a-z0-9]+", "-", re.split("[:,]", table.title)[0].lower()).strip("-")
    return f"tab:{words or 'table'}"


def _parts(table: Content) -> Iterator[Content]:
    """Yield the table in pieces of at most MOST_COLUMNS, divided between names over columns where it has any."""
    names, columns = list(range(table.names)), range(table.names, len(table.headings))
    heads: list[list[int]] = []
    for at in columns:
        group = table.headings[at].group
        if heads and group and group == table.headings[heads[-1][-1]].group:
            heads[-1].append(at)
        else:
            heads.append([at])
    piece: list[int] = []
    for head in heads:
        if piece and len(names) + len(piece) + len(head) > MOST_COLUMNS:
            yield table.only([*names, *piece])
            piece = []
        piece += head
    yield table.only([*names, *piece])


def _tabular(table: Content) -> list[str]:
    """Return the lines of a tabular, by pandas' Styler; columns go by number, since two may have one heading."""
    import pandas as pd

    several = any(heading.group for heading in table.headings)
    numbers = range(len(table.headings))
    columns: pd.Index = pd.Index(numbers)
    if several:
        columns = pd.MultiIndex.from_arrays([[heading.group for heading in table.headings], numbers])
    texts = [[escape(cell.text) for cell in row.cells] for row in table.rows]
    styles = [[_css(cell) for cell in row.cells] for row in table.rows]
    frame = pd.DataFrame(texts, columns=columns, dtype=object)
    look = pd.DataFrame(styles, columns=columns, dtype=object)
    styler = frame.style.hide(axis="index").apply(lambda _: look, axis=None)
    styler = styler.format_index(
        lambda at: _heading(table.columns[cast("int", at)]), axis="columns", level=int(several)
    )
    if several:
        styler = styler.format_index(lambda name: escape(str(name)), axis="columns", level=0)
    aligned = "".join("r" if is_numeric else "l" for is_numeric in table.are_numeric)
    text = styler.to_latex(hrules=True, column_format=aligned, multicol_align="c")
    begin, *inside, end = text.strip().splitlines()
    starts = [at for at, (before, row) in enumerate(pairwise(table.rows), 1) if before.is_mean != row.is_mean]
    for at in reversed(starts):  # a rule apart from the means
        inside.insert(inside.index(r"\midrule") + 1 + at, r"\midrule")
    return [_FITTED, begin, *inside, f"{end}}}"]


def _css(cell: Cell) -> str:
    """Return the commands around a cell as Styler spells them."""
    heat = "" if cell.heat is None else f"cellcolor:{{{heat_name(cell.heat)}}}"
    alarm = "textcolor:{red}--rwrap" if cell.alarm else ""
    return ";".join(filter(None, (heat, alarm)))


def heat_name(value: float) -> str:
    """Return the name of the color of a share or ratio."""
    return next(name for bound, name, _ in HEAT if value < bound)


def _heading(text: str) -> str:
    """Return a heading with percent close to its number."""
    return escape(text).replace(r" \%", r"\,\%")
