"""Validation rules: E rules make a suite unusable, W rules are warnings."""
