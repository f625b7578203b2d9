"""Robot arms and their controller."""
