"""Rows of the retention table, and how they are built."""
