"""Displays that show their figure as the last line of a notebook's cell, whatever pyplot's backend is."""

from io import BytesIO
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Picture = tuple[bytes, dict[str, int]]
"""A PNG, and the size in pixels at which a page shows it."""

_DPI = 160  # of the PNG in a notebook; files for print have more, see `ShownFigure`
_PAGE_DPI = 90  # fewer than the picture has, so that it is sharp on fine screens


class Display:
    """A display that has been plotted shows its figure; `ax_` is what `plot` drew on."""

    ax_: "Axes | None"

    def _repr_png_(self) -> Picture | None:
        if self.ax_ is None:
            return None
        from matplotlib import pyplot as plt
        from matplotlib.figure import Figure

        figure = self.ax_.figure
        assert isinstance(figure, Figure)
        plt.close(figure)  # or the inline backend shows it once more below the cell
        return picture_of(figure)


def picture_of(figure: "Figure") -> Picture:
    """The figure as a notebook's front end takes it."""
    file = BytesIO()
    figure.savefig(file, format="png", dpi=_DPI)
    width, height = figure.get_size_inches()
    return file.getvalue(), {"width": round(width * _PAGE_DPI), "height": round(height * _PAGE_DPI)}
