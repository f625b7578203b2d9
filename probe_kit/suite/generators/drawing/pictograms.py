"""Concepts of Public Info: pictograms of services and prohibitions, each with its icon."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Pictogram:
    """A public sign; a forbidden one is drawn under a red ring and bar.

    shows: what is drawn, where the name says what it stands for instead.
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
