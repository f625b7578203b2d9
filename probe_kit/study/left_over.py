"""What is left of a study file without its wrong values, so that its other mistakes show as well."""

from collections.abc import Iterable, Iterator
from copy import deepcopy
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from probe_kit.study import schema
from probe_kit.study.mistakes import Mistake, Place, part_in_file

_ROUNDS = 5
"""Of leaving out: a value, then its table where that cannot do without it, and so on."""


class LeftOver:
    """The content of a file, of which wrong values are left out. Names in these are no mistakes elsewhere."""

    def __init__(self, content: dict[str, Any]) -> None:
        self._content = deepcopy(content)
        self._names: set[str] = set()
        self._tables: set[Place] = set()
        runs = content.get("runs")
        self._blocks = list(range(len(runs))) if isinstance(runs, list) else []
        """The place in the file of every block that is left."""

    def validated(self, error: ValidationError) -> schema.Study | None:
        """The study of what is left; None where nothing is that can be read."""
        for _ in range(_ROUNDS):
            found = [part_in_file(one["loc"], self._content) for one in error.errors(include_url=False)]
            for path in dict.fromkeys(map(_unit, found)):
                self._leave_out(path)
            self._drop_blocks()
            self._content |= {"schema": 1} | ({} if "name" in self._content else {"name": "study"})
            try:
                return schema.Study.model_validate(self._content)
            except ValidationError as further:
                error = further
        return None

    def own(self, mistakes: Iterable[Mistake]) -> list[Mistake]:
        """Those of the mistakes that do not follow from what was left out, at their places in the file."""
        return [
            replace(one, path=self._in_file(one.path))
            for one in mistakes
            if not one.absent and (one.name or self._in_file(one.path)[:2]) not in self._names | self._tables
        ]

    def _in_file(self, path: Place) -> Place:
        if path[:1] == ("runs",) and len(path) > 1 and isinstance(path[1], int):
            return ("runs", self._blocks[path[1]], *path[2:])
        return path

    def _leave_out(self, path: Place) -> None:
        if not path or part_in_file(path, self._content) != path:
            return
        self._tables.add(self._in_file(path[:2]))
        home: Any = self._content
        for part in path[:-1]:
            home = home[part]
        last = path[-1]
        if isinstance(last, int):  # a block: the others keep their places
            self._names.update(_texts(home[last]))
            home[last] = None
        else:
            self._names.update(_texts({last: home.pop(last)}))

    def _drop_blocks(self) -> None:
        runs = self._content.get("runs")
        if isinstance(runs, list):
            self._blocks = [place for place, block in zip(self._blocks, runs, strict=True) if block is not None]
            self._content["runs"] = [block for block in runs if block is not None]


def _unit(path: Place) -> Place:
    """What is left out for a mistake: a block, or a key with its whole value."""
    numbers = [at for at, part in enumerate(path) if isinstance(part, int) and (path[0], at) != ("runs", 1)]
    return path[: numbers[0]] if numbers else path


def _texts(value: Any) -> Iterator[str]:
    """All names and texts in a value."""
    if isinstance(value, dict):
        yield from map(str, value)
        for own in value.values():
            yield from _texts(own)
    elif isinstance(value, list):
        for own in value:
            yield from _texts(own)
    elif isinstance(value, str):
        yield value
