"""Exports of the frames of a run: films, and a data set that lerobot loads."""
