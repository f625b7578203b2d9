"""Words of tables and figures."""


def spell(category: str) -> str:
    """A category's name as people write it."""
    return category.replace("_", " ")
