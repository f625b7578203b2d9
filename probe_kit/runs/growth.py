"""Growth of a run: what a plan adds to the one that is stored. A run never gets smaller."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from probe_kit.errors import SettingsMismatchError
from probe_kit.runs.layout import RUN_FILE
from probe_kit.runs.results import BUNDLES, bundle_keys
from probe_kit.runs.root import read_root
from probe_kit.runs.store import Location

Row = Mapping[str, Any]
_NUMBER = "episode"
"""The part of a row that depends on when its episode was added."""


@dataclass(frozen=True)
class Growth:
    """A plan beside the one that is stored.

    stored, requested: episodes of either. added: episodes that only the plan has. results: probes and
    interventions that are stored with the run, such as `probes 1a2b3c4d5e6f`; after a growth they are of former
    episodes.
    """

    stored: int
    requested: int
    added: int
    results: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The growth in a line; empty where both plans are the same."""
        if self.added:
            stale = f"; of the former episodes only: {', '.join(self.results)}" if self.results else ""
            return f"from {self.stored} to {self.requested} episodes; stored ones stay as they are{stale}"
        if self.requested < self.stored:
            return f"no: the run has {self.stored} episodes, these {self.requested} among them, and never shrinks"
        return ""


_CONTENT = "content_blake2b"
"""Of recordings: hash of the files that hold an episode."""


def further_rows(stored: Sequence[Row], requested: Sequence[Row], where: str) -> list[Row]:
    """The rows of a plan that the stored one lacks; none if the stored one holds them all.

    Raises SettingsMismatchError if both plan one episode differently, or if each has some that the other lacks.
    """
    was, now = ({row["episode_id"]: row for row in rows} for rows in (stored, requested))
    for name in was.keys() & now.keys():
        _check_equal(was[name], now[name], where)
    added = [row for name, row in now.items() if name not in was]
    lost = [row for name, row in was.items() if name not in now]
    if added and lost:
        raise SettingsMismatchError(
            f"{where} has {_counted(stored)}; this command asks for {_counted(requested)}. A run grows and never "
            f"gets smaller, and {len(lost)} of its episodes are not asked for (the first is "
            f"{lost[0]['episode_id']}). Ask for at least what it has, or choose another --out"
        )
    return added


def _check_equal(was: Row, now: Row, where: str) -> None:
    """Raise SettingsMismatchError unless an episode is planned as it is stored, but for its number."""
    # Every part, not the id alone: an item that was edited keeps its id, and has another content.
    for part in sorted((was.keys() | now.keys()) - {_NUMBER}):
        if was.get(part) != now.get(part):
            if part == _CONTENT:
                raise SettingsMismatchError(
                    f"the files of the data set that hold {was['episode_id']} have changed since {where} began: "
                    f"their {part} is stored as {was.get(part)!r}, here {now.get(part)!r}. Give the data set as "
                    "it was, or choose another --out"
                )
            raise SettingsMismatchError(
                f"{where} plans {was['episode_id']} otherwise: its {part} is stored as {was.get(part)!r}, here "
                f"{now.get(part)!r}. Use the suite, the kind of --wordings and the version of probe_kit that the "
                "run began with, or choose another --out"
            )


def _counted(rows: Sequence[Row]) -> str:
    """Items by category, and the wordings they are asked in."""
    items = {row["item_id"]: row["category"] for row in rows}
    counts = ", ".join(f"{name} {count}" for name, count in sorted(Counter(items.values()).items()))
    wordings = ", ".join(dict.fromkeys(row["wording"] for row in rows if "wording" in row))
    return f"items of {counts}" + (f" in the wordings {wordings}" if wordings else "")


def growth_at(location: Location, requested: Sequence[Row]) -> Growth | None:
    """Return the growth of the run at `location` by a plan with these rows; None if none is there or has a plan.

    Raises as `further_rows`, ActivationsLeftOutError for a copy without activations, and RunDamagedError if the
    stored run was changed.
    """
    if not location.exists(RUN_FILE):
        return None
    root = read_root(location)
    root.check_continuable()
    stored = root.plan
    if not stored:
        return None
    added = len(further_rows(stored, requested, str(location)))
    results = [f"{home} {key}" for home in BUNDLES for key in bundle_keys(location, home)] if added else []
    return Growth(len(stored), len(requested), added, tuple(results))


def check_other_settings(stored: dict[str, Any], requested: dict[str, Any], where: str) -> None:
    """Raise SettingsMismatchError naming the settings that differ between a stored run and this request."""
    was, now = flat_settings(stored), flat_settings(requested)
    different = [key for key in sorted(was | now) if was.get(key) != now.get(key)]
    if different:
        lines = [f"  {key}: stored {was.get(key)!r}, asked {now.get(key)!r}" for key in different]
        raise SettingsMismatchError(
            f"{where} holds a run with other settings:\n" + "\n".join(lines) + "\n"
            "Choose another --out, or repeat the stored settings to continue it"
        )


def flat_settings(value: Any, prefix: str = "") -> dict[str, Any]:
    """Settings by their path, such as `scene.light_level`."""
    if not isinstance(value, Mapping):
        return {prefix: value}
    return {
        key: leaf
        for name, child in value.items()
        for key, leaf in flat_settings(child, f"{prefix}.{name}" if prefix else str(name)).items()
    }
