"""Places of a wildcard at which an answer has no direction: they are passed over, by name."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from probe_kit.errors import NoDirectionError
from probe_kit.intervene.edits.sites import SiteGroup, names_one_place, resolve_all
from probe_kit.intervene.replay.session import ReplaySession


class PassedOver:
    """What `patterns` may leave out. A place that is named must have a direction; one of a wildcard need not."""

    def __init__(self, session: ReplaySession, patterns: Sequence[str]) -> None:
        self._session = session
        self._named = resolve_all([one for one in patterns if names_one_place(one)], session.policy)
        self._cells: set[tuple[SiteGroup, str]] = set()
        self._last: NoDirectionError | None = None

    @contextmanager
    def fitting(self, place: SiteGroup, role: str) -> Iterator[None]:
        """Fit directions there; NoDirectionError is raised for a named place, and recorded for others."""
        try:
            yield
        except NoDirectionError as error:
            if place.name in self._named:
                raise
            self._cells.add((place, role))
            self._last = error
            self._session.passed_over[f"{place.name} {role}"] = str(error)

    def left[T](self, fitted: Mapping[tuple[SiteGroup, str], T]) -> dict[tuple[SiteGroup, str], T]:
        """Return what was fitted without places that a category passed over.

        Raises the last NoDirectionError if no place is left.
        """
        left = {cell: own for cell, own in fitted.items() if cell not in self._cells}
        if not left and self._last is not None:
            raise self._last
        return left
