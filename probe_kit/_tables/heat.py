"""Five colours from lost to kept, the same in LaTeX, figures and pages."""

HEAT = (
    (0.2, "pkheat1", "FFF4CF"),
    (0.4, "pkheat2", "F2DC97"),
    (0.6, "pkheat3", "CFCDB0"),
    (0.8, "pkheat4", "9FBAD0"),
    (float("inf"), "pkheat5", "6FA3DA"),
)
"""Upper bound of retention, colour name, RGB: from lost (pale yellow) to kept (blue).

Lightness alone orders them, so that they differ in grey and for every kind of colour vision."""


def heat_colour(value: float) -> str:
    """The colour `#RRGGBB` of a share or ratio, from lost (pale yellow) to kept (blue)."""
    return f"#{next(rgb for bound, _, rgb in HEAT if value < bound)}"


def heat_key() -> list[tuple[str, str]]:
    """Colour and the shares it stands for, in words, from low to high."""
    bounds = [0.0, *(bound for bound, _, _ in HEAT[:-1])]
    words = [f"{100 * bound:.0f} to {100 * (bound + 0.2):.0f} %" for bound in bounds]
    words[0], words[-1] = "below 20 %", "80 % and more"
    return [(f"#{rgb}", text) for (_, _, rgb), text in zip(HEAT, words, strict=True)]
