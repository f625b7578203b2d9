"""Handling of Ctrl-C and SIGTERM, also before a command has begun."""

import os
import signal

INTERRUPTED = 130
"""The exit code of a command that Ctrl-C ended."""
_ENDING = (signal.SIGINT, signal.SIGTERM)


def leave_at_once() -> None:
    """Make Ctrl-C and SIGTERM end the process in one line until `heed_signals`: there is no work yet to save."""
    for number in _ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as a shell sets it in the background
            signal.signal(number, _leave)


def heed_signals() -> None:
    """Make both signals a KeyboardInterrupt from here on, because work could be under way that is to be saved."""
    for number in _ENDING:
        if signal.getsignal(number) is _leave:
            signal.signal(number, signal.default_int_handler)


def _leave(*_: object) -> None:
    """End the process from within any import: an exception would end in a traceback, or in the import's own."""
    os.write(2, b"interrupted before anything was begun\n")
    os._exit(INTERRUPTED)
