"""The inputs of recorded frames in a run: arrays from which controls are made."""
