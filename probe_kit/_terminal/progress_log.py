"""Progress lines for output that is not a terminal, such as the log of a batch queue."""

import time
from collections.abc import Callable

FIRST = 10.0
"""Seconds until the first line."""
EVERY = 60.0
"""Seconds between two lines."""


class Heartbeat:
    """A progress callback (finished, total, …): a line after `FIRST` seconds, every `EVERY`, and at the end.

    what: what is counted. say: takes each line. clock: seconds, of any origin. The rate is that of what was done
    since the first call: before it a model was loaded, or a run that is continued was made.
    """

    def __init__(
        self, what: str, say: Callable[[str], object], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._what = what
        self._say = say
        self._clock = clock
        self._started = clock()
        self._first: tuple[int, float] | None = None
        self._due = self._started + FIRST
        self._ended: tuple[int, int] | None = None

    def __call__(self, finished: int, total: int, *_: object) -> None:
        """`finished` of `total` are finished; whatever else a caller tells is not used."""
        now = self._clock()
        if self._first is None:
            self._first = finished, now
        # Several events of one answer, as a worker of a Ray cluster gives them, all find the last one counted.
        if (finished, total) == self._ended or (now < self._due and finished < total):
            return
        self._ended = (finished, total) if finished >= total else None
        self._due = now + EVERY
        before, since = self._first
        rate = (finished - before) / (now - since) if now > since else 0.0
        pace = f", {_per_time(rate)}" if rate > 0 else ""
        remaining = f", about {spoken((total - finished) / rate)} left" if rate > 0 and finished < total else ""
        self._say(f"{self._what}: {finished}/{total} after {spoken(now - self._started)}{pace}{remaining}")


def spoken(seconds: float) -> str:
    """A duration in its two largest units: `3 h 12 min`, `4 min 05 s`, `12 s`."""
    minutes, seconds_left = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {seconds_left:02d} s" if minutes else f"{seconds_left} s"


def _per_time(rate: float) -> str:
    """`rate` (per second) in the unit in which it is at least one, as far as an hour goes."""
    for seconds, unit in ((1, "s"), (60, "min")):
        if rate * seconds >= 1:
            return f"{rate * seconds:.1f} per {unit}"
    return f"{rate * 3600:.1f} per h"
