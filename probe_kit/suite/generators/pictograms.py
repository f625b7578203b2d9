"""What Public Info shows: pictograms of services and of what is forbidden, each with its icon."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Pictogram:
    """A public sign; a forbidden one is drawn under a red ring and bar."""

    name: str
    icon: str
    forbidden: bool = False


PICTOGRAMS: tuple[Pictogram, ...] = (
    Pictogram("escalator", "escalator"),
    Pictogram("elevator", "elevator"),
    Pictogram("stairs", "stairs"),
    Pictogram("restroom", "wc"),
    Pictogram("wi-fi", "wifi"),
    Pictogram("restaurant", "restaurant"),
    Pictogram("cafe", "local-cafe"),
    Pictogram("wheelchair", "accessible"),
    Pictogram("baby changing", "baby-changing-station"),
    Pictogram("medical kit", "medical-services"),
    Pictogram("pharmacy", "local-pharmacy"),
    Pictogram("information", "info"),
    Pictogram("baggage", "luggage"),
    Pictogram("post office", "mail"),
    Pictogram("hairdresser", "content-cut"),
    Pictogram("shower", "shower"),
    Pictogram("cash machine", "local-atm"),
    Pictogram("taxi", "local-taxi"),
    Pictogram("train station", "train"),
    Pictogram("airport", "flight"),
    Pictogram("hotel", "hotel"),
    Pictogram("gas station", "local-gas-station"),
    Pictogram("laundry", "local-laundry-service"),
    Pictogram("telephone", "phone"),
    Pictogram("library", "local-library"),
    Pictogram("fire extinguisher", "fire-extinguisher"),
    Pictogram("swimming pool", "pool"),
    Pictogram("gym", "fitness-center"),
    Pictogram("trash bin", "delete"),
    Pictogram("recycling", "recycling"),
    Pictogram("museum", "museum"),
    Pictogram("theater", "theater-comedy"),
    Pictogram("drinking water", "local-drink"),
    Pictogram("ice cream", "icecream"),
    Pictogram("supermarket", "shopping-cart"),
    Pictogram("ferry", "directions-boat"),
    Pictogram("cloakroom", "checkroom"),
    Pictogram("no smoking", "smoking-rooms", forbidden=True),
    Pictogram("no photography", "photo-camera", forbidden=True),
    Pictogram("no pets", "pets", forbidden=True),
    Pictogram("no phones", "smartphone", forbidden=True),
    Pictogram("no food", "lunch-dining", forbidden=True),
    Pictogram("no drinks", "local-bar", forbidden=True),
    Pictogram("no touching", "back-hand", forbidden=True),
    Pictogram("no strollers", "stroller", forbidden=True),
)

LOOK_ALIKES: tuple[set[str], ...] = (
    {"escalator", "stairs"},
    {"cafe", "drinking water"},
    {"taxi", "train station"},
    {"medical kit", "pharmacy"},
    {"trash bin", "drinking water"},
)
