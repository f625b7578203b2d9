"""Progress where no terminal is: now and then one line, so that the log of a batch queue is alive."""

import time
from collections.abc import Callable

FIRST = 10.0
"""Seconds until the first line."""
EVERY = 60.0
"""Seconds between two lines."""


class Heartbeat:
    """A progress callback (done, total, …): a line after `FIRST` seconds, then every `EVERY`, and one at the end.

    what: what is counted. say: takes each line. clock: seconds, of any origin. Work done before the first call, as
    that of a run that is continued, is counted as done but not in the rate.
    """

    def __init__(
        self, what: str, say: Callable[[str], object], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._what = what
        self._say = say
        self._clock = clock
        self._started = clock()
        self._before: int | None = None
        self._due = self._started + FIRST

    def __call__(self, done: int, total: int, *_: object) -> None:
        """`done` of `total` are finished; whatever else a caller tells is not used."""
        now = self._clock()
        if self._before is None:
            self._before = max(done - 1, 0)
        if now < self._due and done < total:
            return
        self._due = now + EVERY
        self._say(f"{self._what}: {done}/{total}{self._pace(done, total, now - self._started)}")

    def _pace(self, done: int, total: int, seconds: float) -> str:
        made = done - (self._before or 0)
        if made <= 0 or seconds <= 0:
            return ""
        rate = made / seconds
        left = f", about {spoken((total - done) / rate)} left" if done < total else f" in {spoken(seconds)}"
        return f", {_per_time(rate)}{left}"


def spoken(seconds: float) -> str:
    """A duration in its two largest units: `3 h 12 min`, `4 min 05 s`, `12 s`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def _per_time(rate: float) -> str:
    """`rate` (per second) in the unit in which it is at least one, as far as an hour goes."""
    for seconds, unit in ((1, "s"), (60, "min")):
        if rate * seconds >= 1:
            return f"{rate * seconds:.1f} per {unit}"
    return f"{rate * 3600:.1f} per h"
