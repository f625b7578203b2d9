"""Probe results: tables, curves, controls; stored with their run."""
