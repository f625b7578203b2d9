"""Plan records: the episodes of a run. A run grows by a further record; none is ever changed.

    plan/00000000.json    the first selection of a suite: its episodes, their order, their whole suite
    plan/<n>.json         the n-th growth: the episodes it adds, and the order of all of them

Commits name the hash of the record that planned their episode. An episode keeps its number for ever; `order` is
that of the same selection planned at once. `run.json` knows nothing of any selection, so two runs of other items
have one identity.
"""

import re
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, ClassVar

from probe_kit.errors import RunDamagedError
from probe_kit.runs.layout import PLANS
from probe_kit.runs.location import Location
from probe_kit.runs.records import RESTORE, Record, expect

Row = dict[str, Any]
_NUMBERED = re.compile(rf"{PLANS}/[0-9]{{8}}\.json")
_SELECTION = {"suite": dict, "categories": list, "items": int}


class PlanRecord(Record):
    """One selection. tokens: T by stream, where pooled views alone are stored. order: of all episodes so far."""

    kind: ClassVar[str] = "plan"
    run: str
    record: int
    selection: dict[str, Any]
    suite_parent: str | None
    tokens: dict[str, int]
    episodes: list[Row]
    order: list[int]


@dataclass(frozen=True)
class StoredPlan:
    """All plan records of a run together.

    rows: the episodes in order. selection, suite_parent, tokens: of the newest record, see `PlanRecord`. extents:
    planned episodes after each record. hashes: of the records, which the commits of their episodes name.
    """

    rows: Sequence[Row] = ()
    selection: Mapping[str, Any] = field(default_factory=dict)
    suite_parent: str | None = None
    tokens: Mapping[str, int] = field(default_factory=dict)
    extents: tuple[int, ...] = ()
    hashes: tuple[str, ...] = ()

    def hash_of(self, number: int) -> str:
        """Hash of the record that added the episode of this number."""
        return self.hashes[bisect_right(self.extents, number)]


def plan_key(record: int) -> str:
    """The key of the plan record of this number; 0 is the first selection."""
    return f"{PLANS}/{record:08d}.json"


def count_plans(location: Location) -> int:
    """Return the number of plan records of a run. A run that begins right now may have none."""
    return next(record for record in count() if not location.exists(plan_key(record)))


def grown_record(
    run: str,
    before: StoredPlan,
    rows: Sequence[Row],
    selection: Mapping[str, Any],
    suite_parent: str | None,
    tokens: Mapping[str, int],
) -> PlanRecord:
    """The record that adds to a plan those of `rows` that it lacks; `rows` hold all that it has.

    run: identity. rows: of all episodes in their order; numbers of new ones are given here.
    """
    numbers = {row["episode_id"]: row["episode"] for row in before.rows}
    added = [row for row in rows if row["episode_id"] not in numbers]
    numbers |= {row["episode_id"]: len(before.rows) + position for position, row in enumerate(added)}
    return PlanRecord(
        run=run,
        record=len(before.extents),
        selection=dict(selection),
        suite_parent=suite_parent,
        # A later selection may have shorter instructions only; the arrays of before keep their length.
        tokens={name: max(length, before.tokens.get(name, 0)) for name, length in tokens.items()},
        episodes=[{**row, "episode": numbers[row["episode_id"]]} for row in added],
        order=[numbers[row["episode_id"]] for row in rows],
    )


def read_plans(location: Location, run: str, check_row: Callable[[Row, str], None]) -> StoredPlan:
    """All plan records together; without any rows for a run that has none yet.

    run: its identity. check_row: raises for a row that is none, given its file's name.
    Raises RunDamagedError if a record is missing, was changed, or belongs elsewhere.
    """
    plan, by_number = StoredPlan(), dict[int, Row]()
    for number in count():
        name = f"{location}/{plan_key(number)}"
        try:
            raw = location.read(plan_key(number))
        except FileNotFoundError:
            break
        record = PlanRecord.parse(raw, name, RESTORE, run=run, record=number)
        _check_selection(record.selection, name)
        for row in record.episodes:
            check_row(row, name)
            by_number[row["episode"]] = row
        _check_order(record, len(plan.rows), by_number, name)
        rows = [by_number[episode] for episode in record.order]
        plan = StoredPlan(
            rows, record.selection, record.suite_parent, record.tokens,
            (*plan.extents, len(rows)), (*plan.hashes, record.hash),
        )  # fmt: skip
    missing = plan_key(len(plan.extents))
    if later := [key for key in location.keys(PLANS) if _NUMBERED.fullmatch(key) and key > missing]:
        raise RunDamagedError(f"{location}/{missing} is missing, though {later[0]} is there. {RESTORE}")
    return plan


def _check_selection(selection: Mapping[str, Any], name: str) -> None:
    """Raise RunDamagedError unless it is a selection of a suite, of recordings, or of an environment."""
    where = f"{name}: the selection"
    for source in ("recording", "played"):
        if source in selection:
            expect(selection, {source: dict}, where, RESTORE)
            expect(selection[source], {"name": str, "episodes": list}, where, RESTORE)
            return
    expect(selection, _SELECTION, where, RESTORE)
    expect(selection["suite"], {"identity": str, "content_sha256": str, "seed_text": str}, where, RESTORE)
    if "wordings" in selection:
        expect(selection, {"wordings": dict}, where, RESTORE)
        expect(selection["wordings"], {"names": list}, where, RESTORE)


def _check_order(record: PlanRecord, before: int, by_number: Mapping[int, Row], name: str) -> None:
    """Raise RunDamagedError unless new episodes are numbered on from `before`, and all of them have a place."""
    numbers = [row["episode"] for row in record.episodes]
    ids = {row["episode_id"] for row in by_number.values()}
    expected = list(range(before + len(numbers)))
    if numbers != expected[before:] or sorted(record.order) != expected or len(ids) != len(expected):
        raise RunDamagedError(f"{name} numbers or orders its episodes in another way than plans do. {RESTORE}")


def while_growing[Result](location: Location, read: Callable[[], Result]) -> Result:
    """The result of `read`, called again if the run grew meanwhile: parts of two states do not fit together.

    Raises what `read` raises.
    """
    while True:
        before = count_plans(location)
        try:
            return read()
        except RunDamagedError:
            if count_plans(location) == before:
                raise
