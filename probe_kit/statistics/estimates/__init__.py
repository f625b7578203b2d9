"""Estimates with intervals: shares, scores of best sites, retention, and their verdicts."""
