"""Locations of runs: folders and prefixes in object stores."""
