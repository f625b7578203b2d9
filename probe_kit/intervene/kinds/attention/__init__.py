"""Attention of the acting stream; descriptive, changes nothing."""
