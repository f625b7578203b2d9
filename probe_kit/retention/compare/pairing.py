"""The sides that are compared: runs, groups of models, VLMs with policies, wordings; and why some are not."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import Any, cast

from probe_kit.env.scoring import DEFAULT_RULE
from probe_kit.errors import UsageError
from probe_kit.retention.behaviour import ask_of, full_names
from probe_kit.retention.compare.compare import (
    CommonItems,
    Difference,
    Side,
    common_items,
    compare,
    has_item_content,
    with_holm,
    wording_of,
)
from probe_kit.retention.compare.models import grew_from, origins_of
from probe_kit.retention.rows.build import RowSettings, RowWithEstimates, run_rows
from probe_kit.runs.layout import FIRST_FRAME
from probe_kit.runs.reader import RunReader

PairedRuns = tuple[list[Difference], tuple[str, ...]]
"""Differences of runs or groups on the items that they have in common; and why others have none, and which items
were left out, a sentence each."""


def compare_runs(
    runs: Sequence[RunReader],
    drawn: Sequence[RowWithEstimates],
    labels: Mapping[str, str],
    against: str | None = None,
    vlm_vla: bool = False,
    pairs: Sequence[tuple[str, str]] | None = None,
) -> PairedRuns:
    """Return every other run minus the run `against`, by default the first; VLM runs and policy runs apart.

    runs: in the order in which they were named. drawn: their rows. labels: what runs are called, by location.
    against: a run's name in tables, its folder's name or its location. vlm_vla: whether VLM runs are compared with
    policy runs elsewhere. pairs: by location, those that are compared instead, each the first minus the
    second. Runs of one seed and wording are compared, on the items that both have: success rates on these alone,
    probes where no run has other items.
    Raises UsageError for a name that is none of the runs, or several.
    """
    if against is not None and len(runs) < 2:
        raise UsageError(f"--compare {against} needs a second run to compare with it")
    names = dict(zip(map(_location_of, runs), full_names(runs, labels), strict=True))
    differences: list[Difference] = []
    unpaired: list[str] = []
    for minuend, subtrahend in _pairs(runs, names, against, pairs):
        both = f"{names[_location_of(minuend)]} and {names[_location_of(subtrahend)]}"
        items = common_items([minuend, subtrahend])
        if why := _why_not(minuend, subtrahend, items):
            unpaired.append(f"{both} are not compared: {why}.")
            continue
        unpaired += _left_out(both, items)
        first, second = (Side.of(names[_location_of(run)], run, drawn) for run in (minuend, subtrahend))
        differences += compare(first, second, items=items)
    if not vlm_vla and pairs is None and len({ask_of(run) is None for run in runs}) == 2:
        unpaired.append("VLM runs and policy runs are not compared with each other; --compare vlm-vla does that.")
    return with_holm(differences), tuple(unpaired)


def compare_groups(
    groups: Mapping[str, Sequence[RunReader]],
    drawn: Sequence[RowWithEstimates],
    against: str | None = None,
    origins: Mapping[str, str] | None = None,
) -> PairedRuns:
    """Return every group of runs minus every earlier one, or minus the group `against`; see `compare_runs`.

    Two groups count as pairs in categories in which all of their runs have at least 80 % of the items in common,
    and then on these items alone. In other categories each group has its own items. origins: see `origins_of`.
    Raises UsageError for a group that is none of them, and a declared origin of no run.
    """
    differences: list[Difference] = []
    notes: list[str] = []
    grown = origins_of([run for of_group in groups.values() for run in of_group], origins)
    for names in group_pairs(list(groups), against):
        runs = [run for name in names for run in groups[name]]
        items = {name: in_common for name, in_common in common_items(runs).items() if in_common.is_many}
        first, second = (
            Side(name, tuple(groups[name]), tuple(row for row in drawn if row.row.group == name), origins=grown)
            for name in names
        )
        notes += _left_out(" and ".join(names), items)
        differences += compare(first, second, items=items, others_too=True)
    return with_holm(differences), tuple(notes)


def group_pairs(groups: Sequence[str], against: str | None = None) -> list[tuple[str, str]]:
    """Return every group with every earlier one, or every other group with `against`: minuend, subtrahend.

    Raises UsageError for a group that is none of them.
    """
    if against is None:
        return [(later, earlier) for earlier, later in combinations(groups, 2)]
    if against not in groups:
        raise UsageError(f"there is no group {against!r} to compare with; there are {', '.join(groups)}")
    return [(name, against) for name in groups if name != against]


def compare_with_vlms(
    runs: Sequence[RunReader],
    drawn: Sequence[RowWithEstimates],
    names: Mapping[str, str],
    pairs: Sequence[tuple[str, str]] | None = None,
) -> list[Difference]:
    """Return every VLM run minus every acting one that it can be compared with, in answers and success alone.

    A policy whose network grew from weights that were asked is not compared with VLMs of other weights. names:
    what runs are called, by location. pairs: locations of the VLM runs and policy runs that are compared instead.
    """
    vlms, policies = ([run for run in runs if _answers(run) == kind] for kind in (True, False))
    related = [(vlm, policy, grew_from(policy, vlm)) for vlm, policy in product(vlms, policies)]
    grown = {_location_of(policy) for _, policy, source in related if source == "yes"}
    differences: list[Difference] = []
    for vlm, policy, source in related:
        if (
            (_location_of(vlm), _location_of(policy)) not in pairs
            if pairs is not None
            else (source == "no" and _location_of(policy) in grown)
        ):
            continue
        items = common_items([vlm, policy]) if wording_of(vlm) == wording_of(policy) else {}
        items = {name: in_common for name, in_common in items.items() if in_common.n_items}
        first, second = (Side.of(names[_location_of(run)], run, drawn) for run in (vlm, policy))
        rows = compare(first, second, "success", items=items, others_too=True)
        differences += [
            replace(
                row,
                source=source,
                paired=row.n_items is not None,
                same_frames=_same_frames(vlm, policy, row.categories or (row.category,), items),
            )
            for row in rows
        ]
    return with_holm(differences)


def _same_frames(
    vlm: RunReader, policy: RunReader, categories: Sequence[str], items: Mapping[str, CommonItems]
) -> bool | None:
    """Return whether all episodes of both began with the same frames; None where a run has no hashes."""
    if FIRST_FRAME not in vlm.episodes or FIRST_FRAME not in policy.episodes:
        return None
    are_same = []
    for category in categories:
        first, second = (run.episodes[run.episodes["category"] == category] for run in (vlm, policy))
        if category in items:
            first, second = items[category].select(first), items[category].select(second)
        both = first[["episode_id", FIRST_FRAME]].merge(second[["episode_id", FIRST_FRAME]], on="episode_id")
        are_same.append(bool(len(both) and (both[f"{FIRST_FRAME}_x"] == both[f"{FIRST_FRAME}_y"]).all()))
    return all(are_same)


# -- wordings ----------------------------------------------------------------------------------------------------


class _InWording:
    """A run with the episodes of one wording, which are not read again; everything else is the run's own."""

    def __init__(self, run: RunReader, wording: str) -> None:
        self._run = run
        self.episodes = run.episodes[run.episodes["wording"] == wording]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._run, name)


def compare_wordings(runs: Sequence[RunReader]) -> list[Difference]:
    """Return every two wordings of each run against each other, the earlier one minus the later.

    It separates not knowing from not being able: who places the cube by "the left picture" and not by what the
    picture shows can act and does not know. runs: those that acted, judged by the rule of the table.
    """
    settings = RowSettings(None, "all", (), DEFAULT_RULE, with_behaviour=False)
    differences: list[Difference] = []
    for run in runs:
        every_wording = run.all_wordings
        sides = {}
        for wording in run.wordings:
            in_wording = cast("RunReader", _InWording(every_wording, wording))
            if len(in_wording.episodes):
                sides[wording] = Side(
                    wording, (in_wording,), tuple(run_rows(in_wording, None, settings)), _location_of(run)
                )
        for first, second in combinations(sides.values(), 2):
            differences += compare(first, second, "success")
    return with_holm(differences)


def _left_out(both: str, items: Mapping[str, CommonItems]) -> list[str]:
    """Return a sentence or two on what a comparison leaves out."""
    none = [name for name, in_common in items.items() if not in_common.n_items]
    part = {
        name: in_common for name, in_common in items.items() if in_common.n_items and not in_common.is_complete
    }
    some = [f"{in_common.n_items} of {in_common.of_items} in {name}" for name, in_common in part.items()]
    sentences = [f"{both} are not compared in {', '.join(none)}: no item in common."] if none else []
    if some:
        sentences.append(
            f"{both} are compared on the items in common: {', '.join(some)}. Probes are not compared there: they "
            "were fitted on other items."
        )
    return sentences


def _location_of(run: RunReader) -> str:
    return str(run.location)


def _pairs(
    runs: Sequence[RunReader],
    names: Mapping[str, str],
    name: str | None,
    pairs: Sequence[tuple[str, str]] | None,
) -> list[tuple[RunReader, RunReader]]:
    if pairs is not None:
        by_location = {_location_of(run): run for run in runs}
        if strange := [location for pair in pairs for location in pair if location not in by_location]:
            raise UsageError(f"{strange[0]} is none of the runs {', '.join(by_location)}")
        return [(by_location[minuend], by_location[subtrahend]) for minuend, subtrahend in pairs]
    against = None if name is None else _run_called(name, runs, names)
    if against is not None:
        return [(run, against) for run in runs if run is not against and _answers(run) == _answers(against)]
    with_first = []
    for are_vlms in (True, False):
        alike = [run for run in runs if _answers(run) == are_vlms]
        with_first += [(subtrahend, alike[0]) for subtrahend in alike[1:]]
    return with_first


def _answers(run: RunReader) -> bool:
    return ask_of(run) is not None


def _run_called(name: str, runs: Sequence[RunReader], names: Mapping[str, str]) -> RunReader:
    for called in (
        _location_of,
        lambda run: names[_location_of(run)],
        lambda run: run.location.name,
        lambda run: run.label,
    ):
        matches = [run for run in runs if called(run) == name.rstrip("/")]
        if len(matches) == 1:
            return matches[0]
    candidates = ", ".join(f"{run.location.name} ({names[_location_of(run)]})" for run in runs)
    raise UsageError(f"--compare {name!r} is {'several' if matches else 'none'} of the runs {candidates}")


def _why_not(minuend: RunReader, subtrahend: RunReader, items: Mapping[str, CommonItems]) -> str:
    """Why two runs cannot be paired, in words that follow a colon; empty if they can."""
    for what, read in _SAME.items():
        mine, theirs = read(minuend), read(subtrahend)
        if None not in (mine, theirs) and mine != theirs:
            return f"other {what} ({mine} and {theirs})"
    if any(in_common.n_items for in_common in items.values()):
        return ""
    if minuend.suite != subtrahend.suite:
        hashed = has_item_content(minuend) and has_item_content(subtrahend)
        unknown = "" if hashed else ", without item hashes in both runs to pair items by"
        return f"other suites ({minuend.suite} and {subtrahend.suite}){unknown}"
    return "no item in common in any category" if items else "no category in common"


_SAME: Mapping[str, Callable[[RunReader], Any]] = {
    "seeds": lambda run: run.settings.get("seed"),
    "wordings": wording_of,
}
"""What two runs must share for the episodes of an item to be the same questions; None where unknown."""
