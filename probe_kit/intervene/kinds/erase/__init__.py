"""Concept erasure: remove what can be read linearly."""
