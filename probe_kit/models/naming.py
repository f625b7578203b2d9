"""Tensor names in released files, mapped to the names of transformers' modules."""

import re
from collections.abc import Sequence

Renames = tuple[tuple[str, str], ...]
"""Patterns and replacements, applied in this order."""

LANGUAGE_FIRST: Renames = (
    (r"^language_model\.lm_head\.", "lm_head."),
    (r"^language_model\.model\.", "model.language_model."),
    (r"^(vision_tower|multi_modal_projector)\.", r"model.\1."),
)
"""Where files hold a whole language model; files saved by today's transformers stay as they are."""


def renamed(name: str, renames: Sequence[tuple[str, str]]) -> str:
    """The module's name of a tensor that a file calls `name`."""
    for pattern, replacement in renames:
        name = re.sub(pattern, replacement, name)
    return name
