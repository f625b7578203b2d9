"""Time: "clock showing 4:30" against another hour, another quarter, or the two hands exchanged."""

from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from probe_kit.suite.generators.drawing import (
    COLORS,
    FULL_DISK,
    RGB,
    Canvas,
    Pen,
    Placement,
    Points,
    Tile,
    background_for,
    ellipse,
    polygon,
    random_placement,
)
from probe_kit.suite.generators.generator import Concept, Generator

# all: twelve numerals; quarters: 12, 3, 6 and 9; mark: ticks and a wedge at twelve, which a turned clock needs
Numerals = Literal["all", "quarters", "mark"]
_NUMERALS: tuple[Numerals, ...] = ("all", "quarters", "mark")
_RIMS = ("black", "blue", "red", "green", "brown")
_FACES: tuple[RGB, ...] = ((252, 252, 252), (252, 246, 228), (232, 242, 252))
_HANDS: RGB = (20, 20, 20)

_LEAST_ANGLE = 22  # degrees between the hands; closer together they hide each other
_HOURS_APART = (2, 3, 4)  # one hour is 30 degrees and vanishes on the far tile


@dataclass(frozen=True)
class ClockTime(Concept):
    """A time on a twelve-hour clock."""

    hour: int = 12
    minute: int = 0

    @property
    def hour_angle(self) -> float:
        """The hour hand in degrees clockwise from twelve."""
        return 30 * (self.hour % 12) + self.minute / 2

    @property
    def minute_angle(self) -> float:
        """The minute hand in degrees clockwise from twelve."""
        return 6.0 * self.minute


@dataclass(frozen=True)
class Clock(Tile):
    """Everything that the picture is drawn from; `ink` is the colour of the rim."""

    hour: int
    minute: int
    numerals: Numerals
    face: RGB
    placement: Placement

    def _paint(self, canvas: Canvas) -> None:
        pen = canvas.pen(self.placement)
        pen.fill(ellipse(0, 0, 0.95, 0.95), self.ink)
        pen.fill(ellipse(0, 0, 0.85, 0.85), self.face)
        _draw_dial(pen, self.numerals)
        reading = _reading(self.hour, self.minute)
        pen.line(_hand(reading.hour_angle, 0.42), _HANDS, 0.13)
        pen.line(_hand(reading.minute_angle, 0.76), _HANDS, 0.07)
        pen.fill(ellipse(0, 0, 0.1, 0.1), _HANDS)


def _direction(angle: float) -> Points:
    return np.array([np.sin(np.deg2rad(angle)), -np.cos(np.deg2rad(angle))])


def _hand(angle: float, length: float) -> Points:
    return np.stack([-0.12 * _direction(angle), length * _direction(angle)])


def _draw_dial(pen: Pen, numerals: Numerals) -> None:
    for hour in range(1, 13):
        toward = _direction(30 * hour)
        if numerals == "all" or (numerals == "quarters" and hour % 3 == 0):
            height = 0.15 if numerals == "all" else 0.22
            x, y = (0.67 * toward).tolist()
            pen.text(str(hour), x, y, height, _HANDS)
        else:
            pen.line(np.stack([0.68 * toward, 0.78 * toward]), _HANDS, 0.05)
    if numerals == "mark":
        pen.fill(polygon((-0.16, -0.84), (0.16, -0.84), (0, -0.56)), _HANDS)


def _reading(hour: int, minute: int) -> ClockTime:
    time = f"{hour}:{minute:02d}"
    return ClockTime(time, f"clock showing {time}", hour=hour, minute=minute)


def _readable(reading: ClockTime) -> bool:
    apart = abs(reading.hour_angle - reading.minute_angle) % 360
    return min(apart, 360 - apart) >= _LEAST_ANGLE


def _confusable(first: ClockTime, second: ClockTime) -> bool:
    """Whether the two differ in exactly one hand, or in which hand is which."""
    apart = (first.hour - second.hour) % 12
    if first.minute == second.minute:
        return min(apart, 12 - apart) in _HOURS_APART
    exchanged = first.minute // 5 == second.hour % 12 and second.minute // 5 == first.hour % 12
    return apart == 0 or exchanged


def _tiles(left: ClockTime, right: ClockTime, rng: np.random.Generator) -> tuple[Clock, Clock]:
    """Draw two clocks, of one make in half of the pairs."""
    makes = rng.integers((3, len(_RIMS), 3), size=(2, 3)).tolist()
    if rng.integers(2):
        makes[1] = makes[0]
    left_clock, right_clock = (
        _clock(reading, rng, *make) for reading, make in zip((left, right), makes, strict=True)
    )
    return left_clock, right_clock


def _clock(reading: ClockTime, rng: np.random.Generator, numerals: int, rim: int, face: int) -> Clock:
    ink = COLORS[_RIMS[rim]]
    return Clock(
        hour=reading.hour,
        minute=reading.minute,
        numerals=_NUMERALS[numerals],
        face=_FACES[face],
        ink=ink,
        background=background_for(ink, rng),
        placement=random_placement(rng, FULL_DISK, turn=6, mirrored=False),
    )


_READINGS = [_reading(hour, minute) for hour in range(1, 13) for minute in (0, 15, 30, 45)]
TIME = Generator(
    category="time",
    pairs=tuple(
        (first, second)
        for first, second in combinations(filter(_readable, _READINGS), 2)
        if _confusable(first, second)
    ),
    tiles=_tiles,
)
