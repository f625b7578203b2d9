"""Edits of token activations, and the directions they use."""
