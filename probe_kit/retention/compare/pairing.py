"""Which of several runs are compared with which, and why some are not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from probe_kit.errors import UsageError
from probe_kit.retention.behaviour.run_labels import full_names
from probe_kit.retention.behaviour.vlm_answers import ask_of
from probe_kit.retention.compare.differences import Difference, Side, pair_differences
from probe_kit.retention.rows.build import RowWithEstimates
from probe_kit.train.data.run_reader import RunReader

if TYPE_CHECKING:
    import pandas as pd

OWN_WORDS = "knowledge"
"""The wording of a run in the items' own words."""


@dataclass(frozen=True)
class PairedRuns:
    """differences: of every two runs on the same questions. unpaired: why others have none, a sentence each."""

    differences: list[Difference]
    unpaired: tuple[str, ...]


def compare_runs(
    runs: Sequence[RunReader],
    drawn: Sequence[RowWithEstimates],
    labels: Mapping[str, str],
    against: str | None = None,
    vlm_vla: bool = False,
) -> PairedRuns:
    """The first run minus every other, or every other minus the run `against`; VLM runs and policy runs apart.

    runs: in the order in which they were named. drawn: their rows. labels: what runs are called, by location.
    against: a run's name in tables, its folder's name or its location. vlm_vla: whether VLM runs are compared with
    policy runs elsewhere. Only runs on the same suite, items, seed and wording are compared.
    Raises UsageError for a name that is none of the runs, or several.
    """
    if against is not None and len(runs) < 2:
        raise UsageError(f"--against {against} needs a second run to compare with it")
    names = dict(zip(map(_place, runs), full_names(runs, labels), strict=True))
    chosen = None if against is None else _run_called(against, runs, names)
    pairs: list[tuple[Side, Side]] = []
    unpaired: list[str] = []
    for here, there in _pairs(runs, chosen):
        both = f"{names[_place(here)]} and {names[_place(there)]}"
        if why := _why_not(here, there):
            unpaired.append(f"{both} are not compared: {why}.")
            continue
        alike, others = _same_episodes(here, there)
        if others:
            unpaired.append(f"{both} are not compared in {', '.join(others)}: other episodes.")
        sides = [
            Side(names[_place(run)], [d for d in drawn if d.row.run.location == _place(run)], _place(run)).only(
                alike
            )
            for run in (here, there)
        ]
        pairs.append((sides[0], sides[1]))
    if not vlm_vla and len({ask_of(run) is None for run in runs}) == 2:
        unpaired.append("VLM runs and policy runs are not compared with each other here; --vlm-vla does that.")
    return PairedRuns(pair_differences(pairs), tuple(unpaired))


def _place(run: RunReader) -> str:
    return str(run.location)


def _pairs(runs: Sequence[RunReader], against: RunReader | None) -> list[tuple[RunReader, RunReader]]:
    if against is not None:
        return [(run, against) for run in runs if run is not against and _asked(run) == _asked(against)]
    found = []
    for asked in (True, False):
        alike = [run for run in runs if _asked(run) == asked]
        found += [(alike[0], other) for other in alike[1:]]
    return found


def _asked(run: RunReader) -> bool:
    return ask_of(run) is not None


def _run_called(name: str, runs: Sequence[RunReader], names: Mapping[str, str]) -> RunReader:
    for called in (_place, lambda run: names[_place(run)], lambda run: run.location.name, lambda run: run.label):
        found = [run for run in runs if called(run) == name.rstrip("/")]
        if len(found) == 1:
            return found[0]
    there = ", ".join(f"{run.location.name} ({names[_place(run)]})" for run in runs)
    raise UsageError(f"--against {name!r} is {'several' if found else 'none'} of the runs {there}")


def _why_not(here: RunReader, there: RunReader) -> str:
    """Why two runs cannot be paired, in words that follow a colon; empty if they can."""
    if here.suite != there.suite:
        return f"other suites ({here.suite} and {there.suite})"
    for what, read in _SAME.items():
        one, other = read(here), read(there)
        if None not in (one, other) and one != other:
            return f"other {what} ({one} and {other})"
    if not set(here.episodes["category"]) & set(there.episodes["category"]):
        return "no category in common"
    return "" if _same_episodes(here, there)[0] else "other episodes in every category"


def _seed(run: RunReader) -> Any:
    return getattr(run, "settings", {}).get("seed")


def _wording(run: RunReader) -> str:
    named = run.episodes["wording"].unique() if "wording" in run.episodes else [OWN_WORDS]
    return ", ".join(map(str, named))


_SAME = {"seeds": _seed, "wordings": _wording}
"""What two runs must share beside the suite for their episodes to be the same questions; None where unknown."""


def _same_episodes(here: RunReader, there: RunReader) -> tuple[list[str], list[str]]:
    """Categories of both in which they have the same items and layouts, and those in which they have not."""
    mine, theirs = (_episodes(run.episodes) for run in (here, there))
    common = [category for category in mine if category in theirs]
    alike = [category for category in common if mine[category] == theirs[category]]
    return alike, [category for category in common if category not in alike]


def _episodes(episodes: "pd.DataFrame") -> dict[str, set[tuple[str, str]]]:
    return {
        str(name): set(zip(table["item_id"].astype(str), table["layout"].astype(str), strict=True))
        for name, table in episodes.groupby("category", sort=False)
    }
