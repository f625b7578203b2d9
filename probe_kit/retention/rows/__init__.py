"""Rows of the retention table, and functions that build them."""
