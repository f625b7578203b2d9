"""Verification of a whole run."""
