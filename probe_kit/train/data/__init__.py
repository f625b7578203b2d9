"""Inputs of probes: samples and labels of a run."""
