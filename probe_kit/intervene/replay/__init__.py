"""Replaying stored inferences and episodes of a run under conditions."""
