"""Checkpoints: finding their files and loading weights strictly."""
