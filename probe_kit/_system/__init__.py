"""Processes, machines and optional libraries."""
