"""Names of token roles and of the pooled views made from them. Imports no torch."""

from collections.abc import Sequence

PADDING = "padding"
CAMERA = "primary"
"""The camera of families whose models know one."""
IMAGE_ROLE = f"image.{CAMERA}"


def plays(role: str, group: str) -> bool:
    """Whether a token of `role` belongs to `group`: `image.wrist` belongs to `image.wrist` and to `image`."""
    return role == group or role.startswith(f"{group}.")


def view_names(roles: Sequence[str]) -> tuple[str, ...]:
    """The pooled views of a stream whose tokens play `roles`: mean, last, and one mean per role.

    With several cameras also `mean:image` over all of them; with one, `resolve_view` finds it under that name.
    """
    images = [role for role in roles if plays(role, "image")]
    content_roles = [role for role in roles if role not in (PADDING, "special")]
    return (
        "mean",
        "last",
        *(f"mean:{role}" for role in content_roles),
        *(["mean:image"] if len(images) > 1 else []),
    )


def resolve_view(view: str, stored: Sequence[str]) -> str:
    """The stored view that `view` names: itself, or `mean:image.<camera>` for `mean:image` of the only camera."""
    if view in stored or not view.startswith("mean:"):
        return view
    parts = [name for name in stored if name.startswith(f"{view}.")]
    return parts[0] if len(parts) == 1 else view


def role_of_view(view: str) -> str | None:
    """Return the role whose tokens a view averages, `all` for `mean`; None for another view."""
    kind, _, role = view.partition(":")
    return (role or "all") if kind == "mean" else None
