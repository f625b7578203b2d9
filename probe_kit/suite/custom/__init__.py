"""Suites of a user's own questions and pictures."""
