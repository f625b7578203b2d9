"""Execution of probe fits: in this process, in several, or on a Ray cluster."""
