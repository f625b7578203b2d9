"""Drift: what training did to what probes find, from one run to another on the same frames and words."""
