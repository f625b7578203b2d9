"""Drawings of the embedded categories."""
