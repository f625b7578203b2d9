"""Scheduling of this thread by the operating system, put back behind libraries that change it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def same_scheduling() -> Iterator[None]:
    """Put the scheduling policy of this thread back at the end.

    For root, the video encoder SVT-AV1 makes the thread that opens it a real-time one of the highest priority. All
    other processes of the machine would then wait for this one, and for those that it starts. Does nothing on
    systems without scheduling policies.
    """
    if not hasattr(os, "sched_setscheduler"):
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)
