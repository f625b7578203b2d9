"""Checks of a whole suite: rules and leakage."""
