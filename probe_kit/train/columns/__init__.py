"""Columns of labels: built in, or of a user's table; cells, values and tasks."""
