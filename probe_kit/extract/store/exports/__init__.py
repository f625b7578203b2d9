"""Runs written for other tools: whole arrays, tables, matrices; see `export`."""
