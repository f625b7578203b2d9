"""Scores of an episode, computed from numbers alone."""
