"""Work for tests of workers: it reports what it takes, unless that is a command below."""

import os
import signal
import sys
from collections.abc import Callable
from typing import Any

from probe_kit.errors import UsageError

DIE, FAIL, BREAK = "die", "fail", "break"


def echo(setup: object, take: Callable[[], Any], report: Callable[[Any], None]) -> None:
    """Reports setup, variable ECHO_SLOT and task."""
    while True:
        task = take()
        if task == DIE:
            os.kill(os.getpid(), signal.SIGKILL)
        if task == BREAK:
            raise ZeroDivisionError
        if task == FAIL:
            raise UsageError("asked to fail")
        report((setup, os.environ.get("ECHO_SLOT"), task))


def stillborn(setup: int, _take: object, _report: object) -> None:
    """Ends at once, with the code of the setup."""
    sys.exit(setup)
