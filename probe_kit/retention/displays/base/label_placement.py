"""Names beside points, placed one after the other where they cover least."""

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Point = tuple[float, float]
Box = tuple[float, float, float, float]

_SIZE = 7.5
"""Of letters, in points."""
# Of one line of text, in points. Estimated: measured widths exist only once the figure is drawn.
_HEIGHT, _CHARACTER = 1.15 * _SIZE, 0.56 * _SIZE
_REACHES = (6.0, 13.0, 22.0, 32.0)  # from the point, in points


def place_labels(
    axes: "Axes",
    points: Sequence[Point],
    names: Sequence[str],
    inks: Sequence[str],
    lines: Sequence[tuple[Point, Point]] = (),
) -> None:
    """Write each name near its point (data coordinates) in its ink, with a thin line where it had to move away.

    lines: level or upright ones by their ends, such as error bars, which names avoid where they can.
    """
    unit = axes.figure.dpi / 72  # pixels per point of type
    anchors = [axes.transData.transform(point) / unit for point in points]
    corners = axes.get_window_extent()
    frame = (corners.x0 / unit, corners.y0 / unit, corners.x1 / unit, corners.y1 / unit)
    occupied: list[Box] = [(x - 3, y - 3, x + 3, y + 3) for x, y in anchors]
    for ends in lines:
        (x0, y0), (x1, y1) = (axes.transData.transform(end) / unit for end in ends)
        occupied.append((min(x0, x1) - 1, min(y0, y1) - 1, max(x0, x1) + 1, max(y0, y1) + 1))

    def in_data(x: float, y: float) -> Point:
        across, up = axes.transData.inverted().transform((x * unit, y * unit))
        return float(across), float(up)

    for name, ink, point, (x, y) in zip(names, inks, points, anchors, strict=True):
        width = _CHARACTER * len(name)
        boxes = [(reach, _box(x, y, width, reach, side)) for reach, side in product(_REACHES, _SIDES)]
        # The least covered area; of equal ones the nearest. Names that were placed before stay where they are.
        reach, box = min(boxes, key=lambda of: (_covered(of[1], occupied) + _outside(of[1], frame), of[0]))
        occupied.append(box)
        start, bottom = in_data(box[0], box[1] + 0.22 * _HEIGHT)
        axes.text(start, bottom, name, fontsize=_SIZE, color=ink, zorder=4)
        if reach > _REACHES[0]:
            across, up = in_data(min(max(x, box[0]), box[2]), min(max(y, box[1]), box[3]))
            axes.plot([point[0], across], [point[1], up], color="0.6", lw=0.5, zorder=1.5)


_SIDES = ((1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1), (0, 1), (0, -1))
"""Directions across and up from a point, the preferred ones first: text on the right reads best."""


def _box(x: float, y: float, width: float, reach: float, side: tuple[int, int]) -> Box:
    start = x + reach if side[0] > 0 else x - reach - width if side[0] < 0 else x - width / 2
    middle = y + side[1] * (reach if side[0] == 0 else 0.8 * reach)
    bottom = middle - _HEIGHT / 2
    return start, bottom, start + width, bottom + _HEIGHT


def _outside(box: Box, frame: Box) -> float:
    """Area of `box` that is not in `frame`, in square points."""
    return (box[2] - box[0]) * (box[3] - box[1]) - _covered(box, [frame])


def _covered(box: Box, boxes: Sequence[Box]) -> float:
    """Area that `box` shares with others, in square points."""
    return sum(
        max(0.0, min(box[2], other[2]) - max(box[0], other[0]))
        * max(0.0, min(box[3], other[3]) - max(box[1], other[1]))
        for other in boxes
    )
