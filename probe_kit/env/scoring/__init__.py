"""Scores of an episode, computed from stored numbers."""
