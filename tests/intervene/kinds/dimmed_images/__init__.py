"""A kind of intervention of its own, as a contributor would add it: the images with less contrast."""
