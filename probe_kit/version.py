"""The version of probe_kit."""

__version__ = "0.2.0"
