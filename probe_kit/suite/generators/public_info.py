"""Public Info: "escalator sign" against another pictogram, prohibitions meet prohibitions half the time."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from probe_kit.suite.generators.drawing import (
    Canvas,
    Pen,
    Placement,
    Points,
    Tile,
    background_for,
    ellipse,
    jitter,
    mask_icon,
    random_placement,
    tint,
)
from probe_kit.suite.generators.generator import Concept, Generator, none_alike, spread_pairs


@dataclass(frozen=True)
class Pictogram:
    """A public sign; a forbidden one is drawn under a red ring and bar.

    Attributes:
        shows: Description of the drawing, where the name says what it means instead; else empty.
    """

    name: str
    icon: str
    forbidden: bool = False
    shows: str = ""


PICTOGRAMS: tuple[Pictogram, ...] = (
    Pictogram("escalator", "escalator"),
    Pictogram("elevator", "elevator"),
    Pictogram("stairs", "stairs"),
    Pictogram("restroom", "wc", shows="man and woman"),
    Pictogram("wi-fi", "wifi"),
    Pictogram("restaurant", "restaurant", shows="fork and knife"),
    Pictogram("cafe", "local-cafe", shows="cup"),
    Pictogram("wheelchair", "accessible"),
    Pictogram("baby changing", "baby-changing-station"),
    Pictogram("medical kit", "medical-services"),
    Pictogram("pharmacy", "local-pharmacy", shows="mortar"),
    Pictogram("information", "info", shows="letter i"),
    Pictogram("baggage", "luggage", shows="suitcase"),
    Pictogram("post office", "mail", shows="envelope"),
    Pictogram("hairdresser", "content-cut", shows="scissors"),
    Pictogram("shower", "shower"),
    Pictogram("cash machine", "local-atm", shows="banknote"),
    Pictogram("taxi", "local-taxi", shows="car"),
    Pictogram("train station", "train", shows="train"),
    Pictogram("airport", "flight", shows="airplane"),
    Pictogram("hotel", "hotel", shows="bed"),
    Pictogram("gas station", "local-gas-station", shows="fuel pump"),
    Pictogram("laundry", "local-laundry-service", shows="washing machine"),
    Pictogram("telephone", "phone", shows="handset"),
    Pictogram("library", "local-library", shows="open book"),
    Pictogram("fire extinguisher", "fire-extinguisher"),
    Pictogram("swimming pool", "pool", shows="swimmer"),
    Pictogram("gym", "fitness-center", shows="dumbbell"),
    Pictogram("trash bin", "delete"),
    Pictogram("recycling", "recycling", shows="three arrows"),
    Pictogram("museum", "museum", shows="building"),
    Pictogram("theater", "theater-comedy", shows="two masks"),
    Pictogram("drinking water", "local-drink", shows="glass"),
    Pictogram("ice cream", "icecream"),
    Pictogram("supermarket", "shopping-cart", shows="shopping cart"),
    Pictogram("ferry", "directions-boat", shows="boat"),
    Pictogram("cloakroom", "checkroom", shows="clothes hanger"),
    Pictogram("no smoking", "smoking-rooms", forbidden=True, shows="crossed-out cigarette"),
    Pictogram("no photography", "photo-camera", forbidden=True, shows="crossed-out camera"),
    Pictogram("no pets", "pets", forbidden=True, shows="crossed-out paw"),
    Pictogram("no phones", "smartphone", forbidden=True, shows="crossed-out phone"),
    Pictogram("no food", "lunch-dining", forbidden=True, shows="crossed-out burger"),
    Pictogram("no drinks", "local-bar", forbidden=True, shows="crossed-out cocktail glass"),
    Pictogram("no touching", "back-hand", forbidden=True, shows="crossed-out hand"),
    Pictogram("no strollers", "stroller", forbidden=True, shows="crossed-out stroller"),
)

LOOK_ALIKES: tuple[set[str], ...] = (
    {"escalator", "stairs"},
    {"cafe", "drinking water"},
    {"taxi", "train station"},
    {"medical kit", "pharmacy"},
    {"trash bin", "drinking water"},
)


# dark: white on a coloured field; light: coloured on a white field; plain: no field; ring: forbidden
Style = Literal["dark", "light", "plain", "ring"]
_STYLES: tuple[Style, ...] = ("dark", "light", "plain")

_WHITE = (250, 250, 250)
_RED = (200, 20, 30)
_INKS = {"black": (24, 24, 24), "blue": (20, 70, 160), "green": (10, 105, 60), "purple": (88, 40, 130)}
_RING = 0.13
_CONTRAST = 90  # a bare pictogram is thin
_SERVICE_PAIRS_EACH = 6  # steps around the circle of services: each meets twelve others
_PICTOGRAM_OF = {pictogram.name: pictogram for pictogram in PICTOGRAMS}
_SHOWS = {pictogram.icon: pictogram.shows for pictogram in PICTOGRAMS}


@dataclass(frozen=True)
class Board(Tile):
    """Everything that the picture is drawn from: a pictogram and the field it lies on."""

    icon: str
    style: Style
    placement: Placement

    def _paint(self, canvas: Canvas) -> None:
        pen = canvas.pen(self.placement)
        mask = mask_icon(self.icon)
        if self.style == "ring":
            pen.fill(ellipse(0, 0, 0.85, 0.85), _RED)
            pen.fill(ellipse(0, 0, 0.85 - _RING, 0.85 - _RING), _WHITE)
            pen.stamp(tint(mask, self.ink), 0, 0, 0.95)
            _bar(pen)
        elif self.style == "plain":
            pen.stamp(tint(mask, self.ink), 0, 0, 1.5)
        else:
            field, glyph = (self.ink, _WHITE) if self.style == "dark" else (_WHITE, self.ink)
            pen.fill(_rounded_square(0.8), self.ink)
            pen.fill(_rounded_square(0.74), field)
            pen.stamp(tint(mask, glyph), 0, 0, 1.3)


def _bar(pen: Pen) -> None:
    reach = (0.85 - _RING / 2) * np.sqrt(0.5)
    pen.line(np.array([(-reach, -reach), (reach, reach)]), _RED, _RING)


def _rounded_square(half: float, radius: float = 0.12) -> Points:
    inner = half - radius
    corners = ((inner, inner, 0), (-inner, inner, 90), (-inner, -inner, 180), (inner, -inner, 270))
    return np.vstack([ellipse(x, y, radius, radius, start, start + 90) for x, y, start in corners])


def _board(concept: Concept, style: Style, rng: np.random.Generator) -> Board:
    pictogram = _PICTOGRAM_OF[concept.name]
    name = "black" if pictogram.forbidden else str(rng.choice(list(_INKS)))
    ink = jitter(_INKS[name], rng)
    placement = random_placement(rng, (0.9, 1.0), turn=6, mirrored=False)
    background = background_for(ink, rng, _CONTRAST)
    return Board(
        pictogram.icon, "ring" if pictogram.forbidden else style, placement, ink=ink, background=background
    )


def _tiles(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[Board, Board]:
    left_style, right_style = (_STYLES[int(number)] for number in rng.integers(len(_STYLES), size=2))
    return _board(left, left_style, rng), _board(right, right_style, rng)


def _concepts(forbidden: bool) -> list[Concept]:
    return [Concept(p.name, f"{p.name} sign") for p in PICTOGRAMS if p.forbidden == forbidden]


def _pairs() -> tuple[tuple[Concept, Concept], ...]:
    """Return pairs of services, pairs of forbidden things, and as many pairs of one of each."""
    services, forbidden = _concepts(False), _concepts(True)

    def kind(concept: Concept) -> bool:
        return _PICTOGRAM_OF[concept.name].forbidden

    among_services = spread_pairs(services, none_alike(LOOK_ALIKES), most=_SERVICE_PAIRS_EACH * len(services))
    among_forbidden = spread_pairs(forbidden, none_alike(LOOK_ALIKES))
    mixed = spread_pairs(services + forbidden, lambda a, b: kind(a) != kind(b), most=len(among_forbidden))
    return among_services + among_forbidden + mixed


def _contents_of_board(board: Board) -> str:
    shows = _SHOWS[board.icon]
    return f"picture of the {shows}" if shows else ""


PUBLIC_INFO = Generator(category="public-info", pairs=_pairs(), tiles=_tiles, name_of=_contents_of_board)
