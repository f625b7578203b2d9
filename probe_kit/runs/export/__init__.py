"""Runs written for other tools: whole arrays, tables, matrices, a LeRobotDataset; see `export`."""
