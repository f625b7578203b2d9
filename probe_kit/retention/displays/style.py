"""What all figures share: colours, markers, axes without clutter, and the caption."""

from dataclasses import dataclass
from math import ceil
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette: apart for every kind of colour vision.
BLUE, VERMILION, GREEN, ORANGE = "#0072B2", "#D55E00", "#009E73", "#E69F00"
SKY, PURPLE, BLACK, GREY = "#56B4E9", "#CC79A7", "#000000", "#8C8C8C"

DPI = 150
_CAPTION_SIZE = 6.5
_CAPTION_PER_INCH = 18.5  # characters of a caption that fit in one inch


@dataclass(frozen=True)
class Line:
    """How one series is drawn; colour is never the only difference."""

    colour: str
    marker: str
    dash: str = "-"


STREAMS = MappingProxyType(
    {"backbone": Line(BLUE, "o"), "expert": Line(VERMILION, "s"), "action": Line(VERMILION, "D")}
)
OTHER_STREAM = Line(GREEN, "^")
STREAM_NAMES = MappingProxyType({"backbone": "backbone", "expert": "action expert", "action": "action tokens"})

SERIES = (
    Line(BLUE, "o"),
    Line(VERMILION, "s", "--"),
    Line(GREEN, "^", "-."),
    Line(PURPLE, "D", ":"),
    Line(ORANGE, "v", (0, (5, 1))),  # type: ignore[arg-type]  # matplotlib also takes (offset, dashes)
    Line(BLACK, "P", (0, (3, 1, 1, 1))),  # type: ignore[arg-type]
    Line(SKY, "X", "-"),
)
"""For models or roles, in order; an eighth one begins again."""


def series(position: int) -> Line:
    """How the series at `position` is drawn."""
    return SERIES[position % len(SERIES)]


def darker(colour: str) -> str:
    """A shade of `#RRGGBB` that text can be read in."""
    return "#" + "".join(f"{int(colour[at : at + 2], 16) * 6 // 10:02X}" for at in (1, 3, 5))


def spell(category: str) -> str:
    """A category's name as people write it."""
    return category.replace("_", " ")


def axes_for(ax: "Axes | None", width: float, height: float) -> "tuple[Axes, Figure | None]":
    """The axes to draw on, and the figure if it was made for them.

    ax: the caller's, or None for new ones of `width` × `height` inches, which a notebook then shows.
    """
    if ax is not None:
        return ax, None
    from matplotlib import pyplot as plt

    from probe_kit.retention.displays.shown_figure import ShownFigure

    figure, axes = plt.subplots(FigureClass=ShownFigure, figsize=(width, height), layout="constrained", dpi=DPI)
    return axes, figure


def panels(
    count: int, width: float = 3.1, height: float = 2.5, columns: int | None = None, *, share: bool = True
) -> "tuple[Figure, list[Axes]]":
    """A figure of `count` panels of `width` × `height` inches, at most three or `columns` in a row."""
    from probe_kit.retention.displays.shown_figure import ShownFigure

    across = columns or (2 if count == 4 else min(3, count))
    rows = ceil(count / across)
    figure = ShownFigure(figsize=(max(width * across, 6.2), height * rows + 1.1), layout="constrained", dpi=DPI)
    grid = list(figure.subplots(rows, across, sharex=share, sharey=share, squeeze=False).flat)
    for position in range(count, len(grid)):
        grid[position].set_visible(False)
        grid[position - across].tick_params(labelbottom=True)
    return figure, grid[:count]


def plain(axes: "Axes") -> None:
    """No frame above and to the right, small tick labels."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def caption(figure: "Figure | None", *certificates: str, label: str = "") -> None:
    """Write `label` and under it the line of each certificate, wrapped where the figure is narrow."""
    if figure is None:
        return
    width = _CAPTION_PER_INCH * figure.get_figwidth()
    lines = [line for certificate in dict.fromkeys(certificates) for line in _wrapped(certificate, width)]
    figure.supxlabel("\n".join([label] * bool(label) + lines), fontsize=_CAPTION_SIZE, color="0.25")


def _wrapped(line: str, width: float) -> list[str]:
    """`line` broken between its parts."""
    first, *rest = line.split(" · ")
    lines = [first]
    for part in rest:
        joined = f"{lines[-1]} · {part}"
        lines[-1:] = [joined] if len(joined) <= width else [lines[-1], part]
    return lines
