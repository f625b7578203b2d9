"""The one sentence every item is made of."""


def instruction_for(object_phrase: str, article: str) -> str:
    """The imperative that names the object, with `article` "the", or "none" for bare names."""
    return f"Put the cube on {'the ' if article == 'the' else ''}{object_phrase}"
