"""Interchange intervention (activation patching) from the run with exchanged pictures."""
