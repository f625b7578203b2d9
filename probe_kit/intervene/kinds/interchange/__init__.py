"""Interchange intervention (activation patching) from the run with swapped images."""
