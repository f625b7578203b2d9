"""Tests. A package, because a dependency installs another `tests` that a process of its own would import."""
