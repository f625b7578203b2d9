"""Capturing and editing activations while a model runs."""
