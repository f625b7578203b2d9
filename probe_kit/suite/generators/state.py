"""State: "open door" and "closed door", asked of the same two doors."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from probe_kit.suite.generators.drawing import (
    COLORS,
    FULL_DISK,
    RGB,
    SHIRT,
    Canvas,
    Pen,
    Placement,
    Tile,
    background_for,
    darker,
    ellipse,
    jitter,
    polygon,
    random_placement,
    rectangle,
)
from probe_kit.suite.generators.generator import Concept, Generator, each

_DARK: RGB = (40, 36, 36)
_WHITE: RGB = (250, 250, 250)
_WOOD: RGB = (150, 100, 56)
_METAL: RGB = (150, 154, 160)
_FLAME: RGB = (252, 190, 40)
_NIGHT: RGB = (54, 44, 44)

Draw = Callable[[Pen, bool, RGB], None]
_VIVID = ("red", "green", "blue", "orange", "purple")


@dataclass(frozen=True)
class TwoStates:
    """A thing that is asked for in one state or in the other.

    Attributes:
        first: Phrase for the thing in the first state.
        second: Phrase for the thing in the second state.
        draw: Function that draws the thing; it takes whether the thing is in the first state.
        colors: Its possible basic colours.
    """

    first: str
    second: str
    draw: Draw
    colors: tuple[str, ...] = _VIVID


def _glass(pen: Pen, full: bool, color: RGB) -> None:
    glass = polygon((-0.56, -0.8), (0.56, -0.8), (0.4, 0.85), (-0.4, 0.85))
    pen.fill(glass, _WHITE)
    if full:
        pen.fill(polygon((-0.53, -0.55), (0.53, -0.55), (0.4, 0.85), (-0.4, 0.85)), color)
    pen.outline(glass, _DARK, 0.07)


def _door(pen: Pen, is_open: bool, color: RGB) -> None:
    pen.fill(rectangle(-0.56, -0.9, 0.56, 0.85), _WOOD)
    if is_open:
        pen.fill(rectangle(-0.44, -0.78, 0.44, 0.85), _NIGHT)
        pen.fill(polygon((-0.44, -0.78), (-0.06, -0.58), (-0.06, 0.95), (-0.44, 0.85)), color)
        pen.fill(ellipse(-0.14, 0.16, 0.05, 0.07), _FLAME)
    else:
        pen.fill(rectangle(-0.44, -0.78, 0.44, 0.85), color)
        pen.outline(rectangle(-0.26, -0.58, 0.26, -0.08), darker(color), 0.06)
        pen.fill(ellipse(0.32, 0.1, 0.08, 0.08), _FLAME)


def _bulb(pen: Pen, is_on: bool, color: RGB) -> None:
    glass = (255, 226, 60) if is_on else (176, 180, 188)
    if is_on:
        for angle in np.deg2rad(np.arange(-210, 31, 40)):
            toward = np.array([np.cos(angle), np.sin(angle)])
            pen.line(np.stack([0.66 * toward, 0.86 * toward]) - np.array([0, 0.12]), (250, 140, 0), 0.1)
    pen.fill(ellipse(0, -0.14, 0.48, 0.48), glass)
    pen.fill(rectangle(-0.2, 0.2, 0.2, 0.46), glass)
    pen.outline(ellipse(0, -0.14, 0.48, 0.48), darker(glass), 0.05)
    pen.fill(rectangle(-0.24, 0.42, 0.24, 0.84), color)


def _plate(pen: Pen, broken: bool, color: RGB) -> None:
    pen.fill(ellipse(0, 0, 0.84, 0.84), color)
    pen.fill(ellipse(0, 0, 0.68, 0.68), _WHITE)
    pen.outline(ellipse(0, 0, 0.44, 0.44), (205, 210, 216), 0.05)
    if broken:
        pen.fill(polygon((0.1, -0.2), (0.55, -0.98), (0.98, -0.5), (0.98, -0.2), (0.3, 0)), _NIGHT)
        for crack in (
            polygon((0.1, -0.1), (-0.2, 0.1), (-0.3, 0.42), (-0.6, 0.58)),
            polygon((0.1, -0.1), (-0.3, -0.3), (-0.5, -0.22), (-0.8, -0.26)),
            polygon((0.1, -0.1), (0.22, 0.3), (0.14, 0.5), (0.3, 0.78)),
        ):
            pen.line(crack, _NIGHT, 0.09)


def _candle(pen: Pen, burning: bool, color: RGB) -> None:
    pen.fill(rectangle(-0.26, -0.1, 0.26, 0.86), color)
    pen.line(polygon((0, -0.1), (0, -0.28)), _DARK, 0.08)
    if burning:
        pen.fill(polygon((0, -0.94), (0.24, -0.46), (0.14, -0.24), (-0.14, -0.24), (-0.24, -0.46)), (245, 120, 10))
        pen.fill(polygon((0, -0.68), (0.12, -0.4), (0, -0.26), (-0.12, -0.4)), (255, 232, 110))


def _box(pen: Pen, is_open: bool, color: RGB) -> None:
    pen.fill(rectangle(-0.6, -0.16, 0.6, 0.76), color)
    if is_open:
        pen.fill(polygon((-0.6, -0.16), (-0.42, -0.46), (0.42, -0.46), (0.6, -0.16)), _NIGHT)
        for side in (-1, 1):
            flap = polygon((side * 0.6, -0.16), (side * 0.42, -0.46), (side * 0.74, -0.76), (side * 0.94, -0.42))
            pen.fill(flap, darker(color))
    else:
        pen.fill(polygon((-0.6, -0.16), (-0.42, -0.46), (0.42, -0.46), (0.6, -0.16)), darker(color))
        pen.fill(rectangle(-0.1, -0.46, 0.1, 0.2), _WHITE)


def _umbrella(pen: Pen, is_open: bool, color: RGB) -> None:
    pen.line(np.vstack([polygon((0, -0.85), (0, 0.6)), ellipse(-0.14, 0.66, 0.14, 0.2, 0, 180)]), _DARK, 0.09)
    if is_open:
        pen.fill(ellipse(0, 0, 0.9, 0.78, 180, 360), color)
        for x in (-0.6, 0, 0.6):
            pen.fill(ellipse(x, 0, 0.3, 0.12), darker(color))
    else:
        pen.fill(polygon((0, -0.88), (0.2, 0.26), (0.08, 0.4), (-0.08, 0.4), (-0.2, 0.26)), color)
        pen.line(polygon((-0.16, 0.1), (0.16, 0.1)), _WHITE, 0.07)


def _banana(pen: Pen, ripe: bool, color: RGB) -> None:
    skin = COLORS["yellow"] if ripe else (60, 160, 60)
    outer, inner = ellipse(0, -0.42, 0.86, 1.1, 10, 170), ellipse(0, -0.5, 0.78, 0.66, 170, 10)
    pen.fill(np.vstack([outer, inner]), skin)
    pen.outline(np.vstack([outer, inner]), darker(skin), 0.05)
    pen.line(polygon((0.82, -0.34), (0.86, -0.56)), color, 0.13)


def _window(pen: Pen, is_open: bool, color: RGB) -> None:
    pen.fill(rectangle(-0.5, -0.7, 0.5, 0.7), _NIGHT if is_open else (176, 220, 248))
    if is_open:
        for side in (-1, 1):
            leaf = polygon((side * 0.5, -0.7), (side * 0.84, -0.5), (side * 0.84, 0.6), (side * 0.5, 0.7))
            pen.fill(leaf, (176, 220, 248))
            pen.outline(leaf, color, 0.09)
    else:
        pen.line(polygon((0, -0.7), (0, 0.7)), color, 0.12)
        pen.line(polygon((-0.5, 0), (0.5, 0)), color, 0.08)
    pen.outline(rectangle(-0.5, -0.7, 0.5, 0.7), color, 0.12)


def _book(pen: Pen, is_open: bool, color: RGB) -> None:
    if not is_open:
        pen.fill(rectangle(-0.5, -0.74, 0.56, 0.74), darker(color))
        pen.fill(rectangle(-0.5, -0.74, 0.46, 0.66), color)
        pen.fill(rectangle(-0.2, -0.44, 0.3, -0.16), _WHITE)
        return
    for side in (-1, 1):
        page = polygon((0, -0.36), (side * 0.86, -0.52), (side * 0.86, 0.4), (0, 0.56))
        pen.fill(page + np.array([0, 0.1]), color)
        pen.fill(page, _WHITE)
        for y in (-0.22, 0.02, 0.26):
            pen.line(polygon((side * 0.18, y - 0.02), (side * 0.68, y - 0.1)), _METAL, 0.07)
    pen.line(polygon((0, -0.36), (0, 0.62)), darker(color), 0.07)


def _switch(pen: Pen, is_on: bool, color: RGB) -> None:
    """Draw a toggle in the manner of a phone's: a bright track with its knob at the end, or a grey one."""
    track = COLORS["green"] if is_on else _METAL
    pen.fill(rectangle(-0.86, -0.62, 0.86, 0.62), color)
    pen.line(polygon((-0.36, 0), (0.36, 0)), track, 0.72)
    pen.fill(ellipse(0.36 if is_on else -0.36, 0, 0.28, 0.28), _WHITE)
    if is_on:
        pen.line(polygon((-0.46, -0.18), (-0.46, 0.18)), _WHITE, 0.1)
    else:
        pen.outline(ellipse(0.42, 0, 0.16, 0.16), _WHITE, 0.09)


def _bottle(pen: Pen, capped: bool, color: RGB) -> None:
    bottle = polygon(
        *((-0.16, -0.6), (0.16, -0.6), (0.16, -0.3), (0.4, 0.02), (0.4, 0.88)),
        *((-0.4, 0.88), (-0.4, 0.02), (-0.16, -0.3)),
    )
    pen.fill(bottle, color)
    pen.fill(rectangle(-0.4, 0.24, 0.4, 0.6), _WHITE)
    if capped:
        pen.fill(rectangle(-0.25, -0.94, 0.25, -0.56), _NIGHT)
    else:
        pen.fill(ellipse(0, -0.6, 0.16, 0.07), _NIGHT)


def _balloon(pen: Pen, inflated: bool, color: RGB) -> None:
    if inflated:
        pen.line(polygon((0, 0.4), (0.1, 0.66), (-0.06, 0.94)), _DARK, 0.06)
        pen.fill(polygon((0, 0.3), (-0.14, 0.54), (0.14, 0.54)), darker(color))
        pen.fill(ellipse(0, -0.26, 0.58, 0.66), color)
        pen.line(ellipse(0, -0.26, 0.36, 0.44, 190, 250), _WHITE, 0.1)
    else:
        limp = np.vstack(
            [ellipse(-0.3, 0.1, 0.42, 0.26, 60, 300), polygon((0.5, 0.02), (0.78, -0.1), (0.78, 0.24))]
        )
        pen.fill(limp, color)
        for x in (-0.3, 0.0):
            pen.line(polygon((x, -0.04), (x + 0.16, 0.18)), darker(color), 0.06)
        pen.line(polygon((0.8, 0.08), (0.9, 0.36), (0.72, 0.56)), _DARK, 0.06)


def _tire(pen: Pen, flat: bool, color: RGB) -> None:
    height = 0.1 if flat else 0
    pen.fill(ellipse(0, height, 0.74, 0.74), _DARK)
    if flat:
        pen.fill(polygon((-0.62, 0.5), (0.62, 0.5), (0.94, 0.84), (-0.94, 0.84)), _DARK)
    pen.fill(ellipse(0, height + 0.02, 0.44, 0.44), _METAL)
    pen.fill(ellipse(0, height + 0.02, 0.18, 0.18), color)
    pen.line(polygon((-0.9, 0.86), (0.9, 0.86)), color, 0.07)


def _toast(pen: Pen, burnt: bool, color: RGB) -> None:
    crumb = (62, 42, 32) if burnt else (244, 206, 142)
    crust = (28, 20, 16) if burnt else (176, 108, 44)
    for size, shade in ((1.0, crust), (0.84, crumb)):
        slice_ = np.vstack([ellipse(0, -0.3, 0.72, 0.46, 180, 360), rectangle(-0.6, -0.2, 0.6, 0.74)[2:]])
        pen.fill(slice_ * size, shade)
    if burnt:
        for x in (-0.3, 0.06, 0.42):
            pen.line(polygon((x, -0.78), (x + 0.08, -0.86), (x, -0.92)), _METAL, 0.06)
    pen.line(polygon((-0.84, 0.86), (0.84, 0.86)), color, 0.1)


def _shirt(pen: Pen, stained: bool, color: RGB) -> None:
    pen.fill(SHIRT, color)
    pen.outline(SHIRT, darker(color), 0.05)
    if stained:
        for x, y, size in ((0.06, 0.12, 0.26), (0.26, 0.34, 0.15), (-0.2, 0.42, 0.12), (-0.22, -0.14, 0.1)):
            pen.fill(ellipse(x, y, size, size * 0.85), (84, 52, 24))


def _egg(pen: Pen, cracked: bool, color: RGB) -> None:
    shell = (252, 232, 204)
    egg = np.vstack([ellipse(0, 0.16, 0.6, 0.66, 0, 180), ellipse(0, 0.16, 0.6, 0.98, 180, 360)])
    pen.line(polygon((-0.7, 0.86), (0.7, 0.86)), color, 0.1)
    pen.fill(egg, shell)
    pen.outline(egg, darker(shell), 0.05)
    if cracked:
        x = np.linspace(-0.6, 0.6, 7)
        pen.line(np.stack([x, np.where(np.arange(7) % 2, -0.14, 0.18)], axis=1), _NIGHT, 0.1)


def _envelope(pen: Pen, sealed: bool, color: RGB) -> None:
    pen.fill(rectangle(-0.82, -0.3, 0.82, 0.66), color)
    if sealed:
        pen.line(polygon((-0.8, -0.28), (0, 0.28), (0.8, -0.28)), darker(color), 0.08)
        pen.fill(ellipse(0, 0.2, 0.16, 0.16), COLORS["red"])
    else:
        pen.fill(polygon((-0.82, -0.3), (0, -0.86), (0.82, -0.3)), darker(color))
        pen.fill(rectangle(-0.6, -0.52, 0.6, 0.1), _WHITE)
        pen.fill(polygon((-0.82, -0.3), (0, 0.24), (0.82, -0.3), (0.82, 0.66), (-0.82, 0.66)), color)


TWO_STATES: tuple[TwoStates, ...] = (
    TwoStates("full glass", "empty glass", _glass),
    TwoStates("open door", "closed door", _door),
    TwoStates("light bulb that is on", "light bulb that is off", _bulb, ("gray", "brown", "black")),
    TwoStates("broken plate", "whole plate", _plate),
    TwoStates("burning candle", "candle that is out", _candle, ("red", "green", "blue", "purple")),
    TwoStates("open box", "closed box", _box, ("brown", "orange", "blue", "green")),
    TwoStates("open umbrella", "closed umbrella", _umbrella),
    TwoStates("ripe banana", "unripe banana", _banana, ("brown", "black")),
    TwoStates("open window", "closed window", _window, ("red", "green", "blue", "brown")),
    TwoStates("open book", "closed book", _book),
    TwoStates("switch that is on", "switch that is off", _switch, ("black", "blue", "brown", "purple")),
    TwoStates("bottle with a cap", "bottle without a cap", _bottle),
    TwoStates("inflated balloon", "deflated balloon", _balloon),
    TwoStates("flat tire", "inflated tire", _tire, ("red", "orange", "blue", "green")),
    TwoStates("burnt toast", "fresh toast", _toast, ("red", "green", "blue", "purple")),
    TwoStates("stained shirt", "clean shirt", _shirt, ("white", "yellow", "pink", "orange")),
    TwoStates("cracked egg", "whole egg", _egg, ("red", "green", "blue", "purple")),
    TwoStates("sealed envelope", "open envelope", _envelope, ("yellow", "orange", "blue", "green")),
)


_THINGS = {name: states for states in TWO_STATES for name in (states.first, states.second)}


@dataclass(frozen=True)
class StateDrawing(Tile):
    """Everything that the picture is drawn from: a thing in the state in which it is asked for."""

    state: str
    placement: Placement

    def _paint(self, canvas: Canvas) -> None:
        states = _THINGS[self.state]
        states.draw(canvas.pen(self.placement), self.state == states.first, self.ink)


def _condition(concept: Concept, rng: np.random.Generator) -> StateDrawing:
    color = str(rng.choice(_THINGS[concept.name].colors))
    ink = jitter(COLORS[color], rng)
    background = background_for(ink, rng)
    return StateDrawing(concept.name, random_placement(rng, FULL_DISK, turn=8), ink=ink, background=background)


STATE = Generator(
    category="state",
    pairs=tuple(
        (Concept(states.first, states.first, "pos"), Concept(states.second, states.second, "neg"))
        for states in TWO_STATES
    ),
    tiles=each(_condition),
)
