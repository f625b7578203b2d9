"""Plan records: which episodes a run has. A run grows by a further record; none is ever changed.

    plan/00000000.json    the first selection of a suite: its episodes, their order, what they were selected from
    plan/<n>.json         the n-th growth: the episodes it adds, and the order of all of them

A record names its run and the record before it, and commits name the record that planned them. An episode keeps
its number for ever; `order` is that of the same selection planned at once. `run.json` knows nothing of any
selection, so two runs of other items have one identity.
"""

import re
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from probe_kit.errors import RunDamagedError
from probe_kit.runs.layout import PLANS
from probe_kit.runs.records import HASH, as_record, expect, read_record
from probe_kit.runs.store import Location

Row = dict[str, Any]
RESTORE = "Restore it from a copy, or extract the run again"
_PARTS = {
    "run": str, "record": int, "selection": dict, "tokens": dict, "episodes": list, "order": list,
}  # fmt: skip
_RECORD = re.compile(rf"{PLANS}/[0-9]{{8}}\.json")
_SELECTION = {"suite": dict, "categories": list, "items": int}


@dataclass(frozen=True)
class StoredPlan:
    """What the plan records of a run say together.

    rows: the episodes in order. selection: settings of the newest record, see `Plan.selection`. suite_parent: hash
    of what its suite was selected from. tokens: T by stream, where pooled views alone are stored. extents: planned
    episodes after each record. hashes: of the records, which the commits of their episodes name.
    """

    rows: Sequence[Row] = ()
    selection: Mapping[str, Any] = field(default_factory=dict)
    suite_parent: str | None = None
    tokens: Mapping[str, int] = field(default_factory=dict)
    extents: tuple[int, ...] = ()
    hashes: tuple[str, ...] = ()

    @property
    def newest(self) -> str | None:
        """Hash of the last record, None without any."""
        return self.hashes[-1] if self.hashes else None

    def hash_of(self, number: int) -> str:
        """Hash of the record that added the episode of this number."""
        return self.hashes[bisect_right(self.extents, number)]


def plan_key(record: int) -> str:
    """Where the plan record of this number lies; 0 is the first selection."""
    return f"{PLANS}/{record:08d}.json"


def count_plans(location: Location) -> int:
    """How many plan records a run has. A run that begins right now may have none."""
    return next(record for record in count() if not location.exists(plan_key(record)))


def grown_record(
    run: str,
    before: StoredPlan,
    rows: Sequence[Row],
    selection: Mapping[str, Any],
    suite_parent: str | None,
    tokens: Mapping[str, int],
) -> bytes:
    """The record that adds to a plan what it lacks of `rows`, which hold all that it has.

    run: identity. rows: of the whole plan in its order; numbers of new ones are given here.
    """
    numbers = {row["episode_id"]: row["episode"] for row in before.rows}
    further = [row for row in rows if row["episode_id"] not in numbers]
    numbers |= {row["episode_id"]: len(before.rows) + place for place, row in enumerate(further)}
    longest = {name: max(length, before.tokens.get(name, 0)) for name, length in tokens.items()}
    return as_record(
        {
            "run": run,
            "record": len(before.extents),
            "former": before.newest,
            "selection": selection,
            "suite_parent": suite_parent,
            "tokens": longest,
            "episodes": [{**row, "episode": numbers[row["episode_id"]]} for row in further],
            "order": [numbers[row["episode_id"]] for row in rows],
        }
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
            record = read_record(location.read(plan_key(number)), name, RESTORE)
        except FileNotFoundError:
            break
        expect(record, _PARTS, name, RESTORE)
        _check_selection(record, name)
        if (record["run"], record["record"], record.get("former")) != (run, number, plan.newest):
            raise RunDamagedError(f"{name} is a plan of another run, or belongs in another place. {RESTORE}")
        for row in record["episodes"]:
            check_row(row, name)
            by_number[row["episode"]] = row
        _check_order(record, len(plan.rows), by_number, name)
        rows = [by_number[one] for one in record["order"]]
        plan = StoredPlan(
            rows, record["selection"], record.get("suite_parent"), record["tokens"],
            (*plan.extents, len(rows)), (*plan.hashes, record[HASH]),
        )  # fmt: skip
    missing = plan_key(len(plan.extents))
    if later := [key for key in location.keys(PLANS) if _RECORD.fullmatch(key) and key > missing]:
        raise RunDamagedError(f"{location}/{missing} is missing, though {later[0]} is there. {RESTORE}")
    return plan


def _check_selection(record: Mapping[str, Any], name: str) -> None:
    """Raise RunDamagedError unless a record says what was selected of which suite or recording."""
    selection, where = record["selection"], f"{name}: the selection"
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
    if not isinstance(record.get("suite_parent", ...), str | None):
        raise RunDamagedError(f"{name} does not say what its suite was selected from. {RESTORE}")


def _check_order(record: Mapping[str, Any], before: int, by_number: Mapping[int, Row], name: str) -> None:
    """Raise RunDamagedError unless new episodes are numbered on from `before`, and all of them have a place."""
    if not all(type(number) is int for number in [*record["order"], *record["tokens"].values()]):
        raise RunDamagedError(f"{name} holds other things than numbers as order or as tokens. {RESTORE}")
    numbers = [row["episode"] for row in record["episodes"]]
    ids = {row["episode_id"] for row in by_number.values()}
    everywhere = list(range(before + len(numbers)))
    if numbers != everywhere[before:] or sorted(record["order"]) != everywhere or len(ids) != len(everywhere):
        raise RunDamagedError(f"{name} numbers or orders its episodes in another way than plans do. {RESTORE}")


def while_growing[Result](location: Location, read: Callable[[], Result]) -> Result:
    """What `read` gives; again if the run grew meanwhile, because parts of two states do not fit together.

    Raises what `read` raises.
    """
    while True:
        before = count_plans(location)
        try:
            return read()
        except RunDamagedError:
            if count_plans(location) == before:
                raise
