"""The scheduler: which episode is played next, and which is given up. Used by all kinds of workers."""

from collections import Counter, defaultdict, deque
from collections.abc import Iterable

from probe_kit.extract.rollout.events import Done, Event, Failed

TRIES = 2


class Scheduler:
    """Assigns episodes to workers and records their events.

    An episode that failed, or was in the hands of a worker that died, is suspect: it is tried once more, by a
    worker that holds nothing else, so that it can take no other episode down with it. Then it is given up.
    """

    def __init__(self, numbers: Iterable[int]) -> None:
        self._fresh = deque(numbers)
        self._suspects: deque[int] = deque()
        self._held: dict[int, set[int]] = defaultdict(set)
        self._failures: Counter[int] = Counter()
        self.done: set[int] = set()
        self.given_up: dict[int, Failed] = {}

    @property
    def finished(self) -> bool:
        """Whether nothing is left to play or in play."""
        return not (self._fresh or self._suspects or any(self._held.values()))

    def take(self, worker: int) -> int | None:
        """The next episode for `worker`; None if it should finish what it holds, or wait."""
        held = self._held[worker]
        if any(number in self._failures for number in held):
            return None
        if self._fresh:
            number = self._fresh.popleft()
        elif self._suspects and not held:
            number = self._suspects.popleft()
        else:
            return None
        held.add(number)
        return number

    def record(self, worker: int, event: Event) -> None:
        """Note what became of an episode."""
        self._held[worker].discard(event.number)
        if isinstance(event, Done):
            self.done.add(event.number)
            return
        self._failures[event.number] += 1
        if self._failures[event.number] < TRIES:
            self._suspects.append(event.number)
        else:
            self.given_up[event.number] = event

    def take_some(self, worker: int, count: int) -> list[int]:
        """Up to `count` episodes for `worker`."""
        numbers: list[int] = []
        while len(numbers) < count and (number := self.take(worker)) is not None:
            numbers.append(number)
        return numbers

    def holds(self, worker: int) -> set[int]:
        """The episodes `worker` has in play."""
        return set(self._held[worker])

    def lose(self, worker: int, reason: str) -> list[Failed]:
        """Note that `worker` died with everything it held."""
        events = [Failed(number, reason) for number in sorted(self._held[worker])]
        for event in events:
            self.record(worker, event)
        return events
