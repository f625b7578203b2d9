"""A figure that notebooks show although pyplot does not know it and `%matplotlib` was not used."""

from io import BytesIO
from typing import Any

from matplotlib.figure import Figure
from matplotlib.text import Text

DrawnPicture = tuple[bytes, dict[str, int]]
"""A PNG, and the size in pixels at which a page shows it."""
PRINT_DPI = 300
_DPI = 160  # of the PNG in a notebook
_PAGE_DPI = 90  # fewer than the picture has, so that it is sharp on fine screens


def picture_of(figure: Figure) -> DrawnPicture:
    """Return the figure in the form that a notebook's front end takes."""
    file = BytesIO()
    figure.savefig(file, format="png", dpi=_DPI)
    width, height = figure.get_size_inches()
    return file.getvalue(), {"width": round(width * _PAGE_DPI), "height": round(height * _PAGE_DPI)}


class ShownFigure(Figure):
    """A matplotlib figure like any other, that also shows itself and saves fit for print.

    Attributes:
        caption: Its origin in full: model, weights, suite, sizes, probes, settings.
    """

    caption: str = ""

    def draw(self, renderer: Any) -> None:
        """Draw; a `$` in the name of a model or category begins no formula."""
        # Here and not at once: texts such as tick labels are made while it is drawn.
        for words in self.findobj(Text):
            words.set_parse_math(False)
        super().draw(renderer)

    def savefig(self, fname: Any, **options: Any) -> None:
        """Save, by default 300 pixels per inch."""
        super().savefig(fname, **{"dpi": PRINT_DPI, **options})

    def _repr_png_(self) -> DrawnPicture:
        return picture_of(self)
