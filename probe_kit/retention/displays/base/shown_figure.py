"""Figures that notebooks show although pyplot does not know them and no `%matplotlib` was said."""

from typing import Any

from matplotlib.figure import Figure
from matplotlib.text import Text

from probe_kit.retention.displays.base.display import Picture, picture_of

PRINT_DPI = 300


class ShownFigure(Figure):
    """A matplotlib figure like any other, that also shows itself and saves fit for print.

    caption: what it is about, in full: model, weights, suite, sizes, probes, settings.
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

    def _repr_png_(self) -> Picture:
        return picture_of(self)
