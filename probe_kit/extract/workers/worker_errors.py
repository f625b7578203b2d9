"""Warnings and errors about workers that ended unexpectedly."""

import warnings


class WorkerLostWarning(UserWarning):
    """A worker died in mid-run; what it had not committed is played again. No number changes."""


def tell_lost(whom: str, again: int) -> None:
    """Warn that a worker is gone. whom: which one and why. again: how many of its episodes are played again."""
    what = "it held no episode" if again == 0 else f"{again} episodes it held are played again"
    warnings.warn(f"{whom}; {what}", WorkerLostWarning, stacklevel=2)
