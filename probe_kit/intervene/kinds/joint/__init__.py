"""Joint places: which cells carry the effect together, which alone, and which are needed."""
