"""Comparison with outputs of the original implementation."""
