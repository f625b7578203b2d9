"""Recordings as a source of observations: what is chosen of a LeRobotDataset, how it is read, and its rows."""
