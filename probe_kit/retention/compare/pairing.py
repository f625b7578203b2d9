"""Which of several runs are compared with which, and why some are not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from probe_kit.errors import UsageError
from probe_kit.retention.behaviour.run_labels import full_names
from probe_kit.retention.behaviour.success_rate import success_share
from probe_kit.retention.behaviour.vlm_answers import ask_of
from probe_kit.retention.compare.common_items import (
    CommonItems,
    common_items,
    has_item_content,
    wording_of,
)
from probe_kit.retention.compare.differences import (
    ComparedSides,
    Difference,
    Side,
    group_pairs,
    pair_differences,
)
from probe_kit.retention.compare.origins import origins_of
from probe_kit.retention.estimators.stream_scores import RowEstimates
from probe_kit.retention.rows.build import RowWithEstimates
from probe_kit.train.data.run_reader import RunReader, seed_text_of


@dataclass(frozen=True)
class PairedRuns:
    """differences: of runs or groups on the items that they have in common. unpaired: why others have none, and
    which items were left out, a sentence each.
    """

    differences: list[Difference]
    unpaired: tuple[str, ...]


def compare_runs(
    runs: Sequence[RunReader],
    drawn: Sequence[RowWithEstimates],
    labels: Mapping[str, str],
    against: str | None = None,
    vlm_vla: bool = False,
    chosen: Sequence[tuple[str, str]] | None = None,
) -> PairedRuns:
    """Return every other run minus the run `against`, by default the first; VLM runs and policy runs apart.

    runs: in the order in which they were named. drawn: their rows. labels: what runs are called, by location.
    against: a run's name in tables, its folder's name or its location. vlm_vla: whether VLM runs are compared with
    policy runs elsewhere. chosen: by location, the pairs that are compared instead, each the first minus the
    second. Runs of one seed and wording are compared, on the items that both have: success rates on these alone,
    probes where no run has other items.
    Raises UsageError for a name that is none of the runs, or several.
    """
    if against is not None and len(runs) < 2:
        raise UsageError(f"--against {against} needs a second run to compare with it")
    names = dict(zip(map(_place, runs), full_names(runs, labels), strict=True))
    pairs: list[ComparedSides] = []
    unpaired: list[str] = []
    for here, there in _pairs(runs, names, against, chosen):
        both = f"{names[_place(here)]} and {names[_place(there)]}"
        items = common_items([here, there])
        if why := _why_not(here, there, items):
            unpaired.append(f"{both} are not compared: {why}.")
            continue
        sides = [
            Side(names[_place(run)], [d for d in drawn if d.row.run.location == _place(run)], _place(run))
            for run in (here, there)
        ]
        unpaired += _left_out(both, items)
        pairs.append(_on_common_items((sides[0], sides[1]), items, [here, there]))
    if not vlm_vla and chosen is None and len({ask_of(run) is None for run in runs}) == 2:
        unpaired.append("VLM runs and policy runs are not compared with each other here; --vlm-vla does that.")
    return PairedRuns(pair_differences(pairs), tuple(unpaired))


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
    pairs, notes = [], []
    grown = origins_of([run for of_group in groups.values() for run in of_group], origins)
    for names in group_pairs(list(groups), against):
        runs = [run for name in names for run in groups[name]]
        items = {name: one for name, one in common_items(runs).items() if one.is_many}
        sides = [Side(name, [one for one in drawn if one.row.group == name], origins=grown) for name in names]
        notes += _left_out(" and ".join(names), items)
        pairs.append(_on_common_items((sides[0], sides[1]), items, runs, others_too=True))
    return PairedRuns(pair_differences(pairs), tuple(notes))


def _on_common_items(
    sides: tuple[Side, Side],
    items: Mapping[str, CommonItems],
    runs: Sequence[RunReader],
    others_too: bool = False,
) -> ComparedSides:
    """Both sides on the same items, with the draws of the first of `runs`.

    others_too: keep categories without such items.
    """
    seed_texts = {_place(run): seed_text_of(run) for run in runs}
    seed_text = seed_text_of(runs[0])

    def common(one: RowWithEstimates) -> RowWithEstimates:
        own = items.get(one.row.category)
        if own is None or (own.whole and seed_texts[one.row.run.location] == seed_text):
            return one
        outcomes = None if one.outcomes is None else own.select(one.outcomes)
        rates = {} if outcomes is None else {"sr": success_share(outcomes, seed_text)}
        streams = one.estimates.streams if own.whole else None
        return replace(
            one,
            estimates=RowEstimates(rates, None if streams is None else streams.as_of(seed_text)),
            outcomes=outcomes,
        )

    kept = {name for name, own in items.items() if own.n_items}
    here, there = (
        replace(side, drawn=[common(one) for one in side.drawn if others_too or one.row.category in kept])
        for side in sides
    )
    return ComparedSides(here, there, items)


def _left_out(both: str, items: Mapping[str, CommonItems]) -> list[str]:
    """What a comparison leaves out, a sentence or two."""
    none = [name for name, own in items.items() if not own.n_items]
    part = {name: own for name, own in items.items() if own.n_items and not own.whole}
    some = [f"{own.n_items} of {own.of_items} in {name}" for name, own in part.items()]
    found = [f"{both} are not compared in {', '.join(none)}: no item in common."] if none else []
    if some:
        found.append(
            f"{both} are compared on the items in common: {', '.join(some)}. Probes are not compared there: they "
            "were fitted on other items."
        )
    return found


def _place(run: RunReader) -> str:
    return str(run.location)


def _pairs(
    runs: Sequence[RunReader],
    names: Mapping[str, str],
    name: str | None,
    chosen: Sequence[tuple[str, str]] | None,
) -> list[tuple[RunReader, RunReader]]:
    if chosen is not None:
        there = {_place(run): run for run in runs}
        if strange := [place for pair in chosen for place in pair if place not in there]:
            raise UsageError(f"{strange[0]} is none of the runs {', '.join(there)}")
        return [(there[one], there[other]) for one, other in chosen]
    against = None if name is None else _run_called(name, runs, names)
    if against is not None:
        return [(run, against) for run in runs if run is not against and _asked(run) == _asked(against)]
    found = []
    for asked in (True, False):
        alike = [run for run in runs if _asked(run) == asked]
        found += [(other, alike[0]) for other in alike[1:]]
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


def _why_not(here: RunReader, there: RunReader, items: Mapping[str, CommonItems]) -> str:
    """Why two runs cannot be paired, in words that follow a colon; empty if they can."""
    for what, read in _SAME.items():
        one, other = read(here), read(there)
        if None not in (one, other) and one != other:
            return f"other {what} ({one} and {other})"
    if any(own.n_items for own in items.values()):
        return ""
    if here.suite != there.suite:
        hashed = has_item_content(here) and has_item_content(there)
        unknown = "" if hashed else ", without item hashes in both runs to pair items by"
        return f"other suites ({here.suite} and {there.suite}){unknown}"
    return "no item in common in any category" if items else "no category in common"


def _seed(run: RunReader) -> Any:
    return getattr(run, "settings", {}).get("seed")


_SAME = {"seeds": _seed, "wordings": wording_of}
"""What two runs must share for the episodes of an item to be the same questions; None where unknown."""
