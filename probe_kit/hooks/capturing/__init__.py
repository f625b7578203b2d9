"""Capture and edit activations while a model runs."""
