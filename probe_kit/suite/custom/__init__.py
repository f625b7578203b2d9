"""Suites from a user's own questions and pictures."""
