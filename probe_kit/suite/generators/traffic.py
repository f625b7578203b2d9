"""Traffic: "no entry sign" against another road sign, of the same family in half of the pairs.

No name contains a side word: signs that turn left or right are not in this suite.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from probe_kit.suite.generators.drawing import (
    FULL_DISK,
    RGB,
    Canvas,
    Pen,
    Placement,
    Points,
    Tile,
    background_for,
    ellipse,
    mask_icon,
    polygon,
    random_placement,
    rectangle,
    tint,
)
from probe_kit.suite.generators.generator import Concept, Generator, each_on_hues, half_within, none_alike

_RED: RGB = (200, 20, 34)
_BLUE: RGB = (16, 76, 170)
_YELLOW: RGB = (250, 200, 20)
_GREEN: RGB = (24, 150, 60)
_WHITE: RGB = (250, 250, 250)
_BLACK: RGB = (22, 22, 22)

_TRIANGLE = polygon((0, -0.92), (0.94, 0.72), (-0.94, 0.72))
_BAR = 0.14
_STROKE = 0.16

Draw = Callable[[Pen], None]


@dataclass(frozen=True)
class RoadSign:
    """A sign with its family, which is also its shape, and a function that draws it in the unit disk."""

    name: str
    family: str
    edge: RGB
    draw: Draw


def _layers(*layers: Draw) -> Draw:
    """Return a function that draws one layer over the other."""

    def draw(pen: Pen) -> None:
        for layer in layers:
            layer(pen)

    return draw


def _fills(color: RGB, *shapes: Points) -> Draw:
    return _layers(*(partial(Pen.fill, points=points, color=color) for points in shapes))


def _strokes(color: RGB, width: float, *lines: Points) -> Draw:
    return _layers(*(partial(Pen.line, points=points, color=color, width=width) for points in lines))


def _disk(radius: float, color: RGB) -> Draw:
    return _fills(color, ellipse(0, 0, radius, radius))


def _icon(name: str, color: RGB, height: float, x: float = 0, y: float = 0) -> Draw:
    return lambda pen: pen.stamp(tint(mask_icon(name), color), x, y, height)


def _text(text: str, color: RGB, height: float) -> Draw:
    return lambda pen: pen.text(text, 0, 0, height, color)


def _ring(symbol: Draw, field: RGB = _WHITE, bars: int = 0) -> Draw:
    diagonals = (polygon((-0.56, -0.56 * slope), (0.56, 0.56 * slope)) for slope in (1, -1)[:bars])
    return _layers(_disk(0.92, _RED), _disk(0.74, field), symbol, _strokes(_RED, _BAR, *diagonals))


_warning = partial(_layers, _fills(_RED, _TRIANGLE), _fills(_WHITE, _TRIANGLE * 0.72 + np.array([0, 0.06])))
_order = partial(_layers, _disk(0.92, _BLUE))
_notice = partial(_layers, _fills(_BLUE, rectangle(-0.78, -0.78, 0.78, 0.78)))
_blacks, _whites = partial(_fills, _BLACK), partial(_fills, _WHITE)
_black_strokes = partial(_strokes, _BLACK, _STROKE)

_ARROW = polygon((-0.12, 0.6), (-0.12, -0.1), (-0.38, -0.1), (0, -0.62), (0.38, -0.1), (0.12, -0.1), (0.12, 0.6))
_DIAMOND = polygon((0, -0.95), (0.95, 0), (0, 0.95), (-0.95, 0))
_ROCK = polygon((-0.5, 0.56), (-0.5, 0.1), (-0.28, -0.14), (-0.2, 0.14), (0.02, 0.34), (0.14, 0.56))
_ROCKS = ((0.04, -0.1, 0.12), (0.26, 0.18, 0.12), (0.42, 0.44, 0.11))
_GIVE_WAY = _layers(_fills(_RED, -_TRIANGLE), _fills(_WHITE, -(_TRIANGLE * 0.66 + np.array([0, 0.07]))))
_PRIORITY_ROAD = _layers(
    _fills(_BLACK, _DIAMOND), _fills(_WHITE, _DIAMOND * 0.93), _fills(_YELLOW, _DIAMOND * 0.66)
)
_END_OF_RESTRICTIONS = _layers(
    _disk(0.92, _BLACK),
    _disk(0.84, _WHITE),
    _strokes(
        _BLACK,
        0.09,
        *(polygon((x - 0.42, x + 0.42), (x + 0.42, x - 0.42)) * 1.05 for x in (-0.24, 0, 0.24)),
    ),
)
_TRAFFIC_LIGHTS = _layers(
    _blacks(rectangle(-0.24, -0.42, 0.24, 0.64)),
    *(_fills(color, ellipse(0, y, 0.14, 0.14)) for y, color in ((-0.22, _RED), (0.11, _YELLOW), (0.44, _GREEN))),
)
_FALLING_ROCKS = _blacks(_ROCK, *(ellipse(x, y, size, size) for x, y, size in _ROCKS))
_NO_OVERTAKING = _layers(_icon("directions-car", _RED, 0.66, x=-0.3), _icon("directions-car", _BLACK, 0.66, x=0.3))
_DEAD_END = _layers(_whites(rectangle(-0.14, -0.3, 0.14, 0.78)), _fills(_RED, rectangle(-0.5, -0.58, 0.5, -0.26)))
_CROSSWALK = _layers(
    _whites(polygon((0, -0.7), (0.72, 0.62), (-0.72, 0.62))), _icon("directions-walk", _BLACK, 0.86, y=0.16)
)


def _stop(pen: Pen) -> None:
    angles = np.deg2rad(np.arange(22.5, 360, 45))
    octagon = 0.95 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    pen.fill(octagon, _RED)
    pen.outline(octagon * 0.86, _WHITE, 0.07)
    pen.text("STOP", 0, 0, 0.42, _WHITE)


def _roundabout(pen: Pen) -> None:
    for start in (0, 120, 240):
        pen.line(ellipse(0, 0, 0.5, 0.5, start, start + 62), _WHITE, 0.17)
        tip = np.deg2rad(start + 100)
        heading = np.array([-np.sin(tip), np.cos(tip)])
        outward = np.array([np.cos(tip), np.sin(tip)])
        base = 0.5 * np.array([np.cos(np.deg2rad(start + 66)), np.sin(np.deg2rad(start + 66))])
        pen.fill(np.stack([base + 0.26 * outward, base - 0.26 * outward, base + 0.4 * heading]), _WHITE)


def _speed_limit(limit: int) -> RoadSign:
    return RoadSign(f"speed limit {limit}", "prohibition", _RED, _ring(_text(str(limit), _BLACK, 0.56)))


_warned = partial(RoadSign, family="warning", edge=_RED)
_forbidden = partial(RoadSign, family="prohibition", edge=_RED)
_ordered = partial(RoadSign, family="mandatory", edge=_BLUE)
_noticed = partial(RoadSign, family="information", edge=_BLUE)

_BUMPS = np.vstack([ellipse(-0.22, 0.42, 0.24, 0.3, 180, 360), ellipse(0.22, 0.42, 0.24, 0.3, 180, 360)])
_DIAGONAL = polygon((-0.3, -0.12), (0.3, 0.48))
_SLOPE = polygon((-0.54, 0.56), (-0.54, 0.36), (0.3, -0.1), (0.54, 0.56))
_NARROWING = polygon((0.34, 0.6), (0.34, 0.3), (0.14, 0.1), (0.14, -0.3))
_ALL = (
    _warned("danger", draw=_warning(_blacks(rectangle(-0.1, -0.36, 0.1, 0.26), ellipse(0, 0.46, 0.12, 0.12)))),
    _warned("traffic lights", draw=_warning(_TRAFFIC_LIGHTS)),
    _warned("falling rocks", draw=_warning(_FALLING_ROCKS)),
    _warned("road works", draw=_warning(_icon("construction", _BLACK, 0.82, y=0.2))),
    _warned("railway crossing", draw=_warning(_icon("train", _BLACK, 0.84, y=0.18))),
    _warned("bumpy road", draw=_warning(_blacks(_BUMPS, rectangle(-0.56, 0.4, 0.56, 0.54)))),
    _warned("narrow road", draw=_warning(_black_strokes(_NARROWING, _NARROWING * np.array([-1, 1])))),
    _warned("crossroads", draw=_warning(_black_strokes(_DIAGONAL, _DIAGONAL * np.array([-1, 1])))),
    _warned("steep hill", draw=_warning(_blacks(_SLOPE))),
    _warned("icy road", draw=_warning(_icon("ac-unit", _BLACK, 0.84, y=0.18))),
    _forbidden("no entry", draw=_ring(_whites(rectangle(-0.6, -0.18, 0.6, 0.18)), field=_RED)),
    _forbidden("road closed", draw=_ring(_layers())),
    *(_speed_limit(limit) for limit in (30, 50, 80)),
    _forbidden("no parking", draw=_ring(_layers(), field=_BLUE, bars=1)),
    _forbidden("no stopping", draw=_ring(_layers(), field=_BLUE, bars=2)),
    _forbidden("no bicycles", draw=_ring(_icon("pedal-bike", _BLACK, 1.05))),
    _forbidden("no trucks", draw=_ring(_icon("local-shipping", _BLACK, 1.0))),
    _forbidden("no pedestrians", draw=_ring(_icon("directions-walk", _BLACK, 1.1))),
    _forbidden("no motorcycles", draw=_ring(_icon("two-wheeler", _BLACK, 1.08))),
    _forbidden("no overtaking", draw=_ring(_NO_OVERTAKING)),
    _ordered("straight ahead", draw=_order(_whites(_ARROW))),
    _ordered("roundabout", draw=_order(_roundabout)),
    _ordered("bicycle path", draw=_order(_icon("pedal-bike", _WHITE, 1.25))),
    _ordered("footpath", draw=_order(_icon("directions-walk", _WHITE, 1.3))),
    _noticed("parking", draw=_notice(_text("P", _WHITE, 0.95))),
    _noticed("hospital", draw=_notice(_text("H", _WHITE, 0.9))),
    _noticed("dead end", draw=_notice(_DEAD_END)),
    _noticed("crosswalk", draw=_notice(_CROSSWALK)),
    _noticed("bus stop", draw=_notice(_icon("directions-bus", _WHITE, 1.3))),
    RoadSign("stop", "priority", _RED, _stop),
    RoadSign("give way", "priority", _RED, _GIVE_WAY),
    RoadSign("priority road", "priority", _BLACK, _PRIORITY_ROAD),
    RoadSign("end of restrictions", "priority", _BLACK, _END_OF_RESTRICTIONS),
)
ROAD_SIGNS: dict[str, RoadSign] = {sign.name: sign for sign in _ALL}
ROAD_SIGN_ICONS = (
    *("construction", "train", "ac-unit", "pedal-bike", "local-shipping", "directions-walk", "two-wheeler"),
    *("directions-car", "directions-bus"),
)

# Too much alike on a small tile.
LOOK_ALIKES: tuple[set[str], ...] = (
    {"no bicycles", "no motorcycles"},
    {"speed limit 30", "speed limit 50", "speed limit 80"},
)


@dataclass(frozen=True)
class SignPost(Tile):
    """Everything that the picture is drawn from; `ink` is the colour of the sign's edge."""

    sign: str
    placement: Placement

    def _paint(self, canvas: Canvas) -> None:
        ROAD_SIGNS[self.sign].draw(canvas.pen(self.placement))


def _sign_post(concept: Concept, rng: np.random.Generator) -> SignPost:
    ink = ROAD_SIGNS[concept.name].edge
    placement = random_placement(rng, FULL_DISK, turn=8, mirrored=False)
    return SignPost(concept.name, placement, ink=ink, background=background_for(ink, rng))


TRAFFIC = Generator(
    category="traffic",
    pairs=half_within(
        [Concept(name, f"{name} sign") for name in ROAD_SIGNS],
        family=lambda concept: ROAD_SIGNS[concept.name].family,
        allowed=none_alike(LOOK_ALIKES),
    ),
    tiles=each_on_hues(_sign_post),
)
