"""Figures that notebooks show although pyplot does not know them and no `%matplotlib` was said."""

from matplotlib.figure import Figure

from probe_kit.retention.displays.showing import Picture, picture_of


class ShownFigure(Figure):
    """A matplotlib figure like any other, that also shows itself."""

    def _repr_png_(self) -> Picture:
        return picture_of(self)
