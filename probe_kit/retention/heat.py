"""Five colours from lost to kept, the same in LaTeX, figures and pages."""

HEAT = (
    (0.2, "pkheat1", "FDE0DD"),
    (0.4, "pkheat2", "FBD3C0"),
    (0.6, "pkheat3", "FEF0C7"),
    (0.8, "pkheat4", "E2F0CB"),
    (float("inf"), "pkheat5", "C3E6C3"),
)
"""Upper bound of retention, colour name, RGB: from lost (red) to kept (green)."""


def heat_colour(value: float) -> str:
    """The colour `#RRGGBB` of a share or ratio, from lost (red) to kept (green)."""
    return f"#{next(rgb for bound, _, rgb in HEAT if value < bound)}"
