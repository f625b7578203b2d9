"""Crews: which episode is played next, and by whom: this process, several, or actors on a Ray cluster."""
