"""Exports of the frames of a run: films, recordings of rerun, and a data set that lerobot loads."""
