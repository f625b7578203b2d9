"""The layer to look at, in one line per category: where the answer passes, where it is read, what probes read."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.hooks.registry import get_family
from probe_kit.intervene.edits.pooled_directions import MEAN_DIFFERENCE
from probe_kit.intervene.edits.sites import ALL, list_places
from probe_kit.intervene.edits.unread import unread_places
from probe_kit.intervene.kinds.image_swap.verdict import Places
from probe_kit.intervene.kinds.site_effects import PatchEffect
from probe_kit.intervene.results.best_targets import best_cell
from probe_kit.intervene.results.site_maps import (
    BACKBONE,
    is_backbone_layer,
    stored_site_effects,
    stored_subspace_effects,
)
from probe_kit.intervene.results.ties import TieAtSite, role_of_view, tie_at_site
from probe_kit.suite.categories import category_of
from probe_kit.train.data.run_reader import RunReader

if TYPE_CHECKING:
    from probe_kit.train.results.probe_results import ProbeResults

ALONG = f"{MEAN_DIFFERENCE}:1"
"""Direction that moves an answer in every token alike, and one that lies in which tokens are marked."""
_NOT_PATCHED = "was not patched"
_TIES: dict[TieAtSite, str] = {
    "read": "is read",
    "unread": "is unread",
    "another code": "holds another code than the one that is used",
    "in part": "carries a part of the effect",
    "not tested": _NOT_PATCHED,
}


def which_layer(
    run: RunReader, results: "ProbeResults | None", places: Mapping[str, Places], categories: Sequence[str]
) -> dict[str, str]:
    """By category: where the answer passes, where it is read, and whether the probes' best site is read.

    results: the newest probes, None without any. places: as `stored_places` gives them. Of stored interchanges and
    joint places; what was not tested is named with the command that tests it.
    """
    maps, along = stored_site_effects(run), stored_subspace_effects(run)
    found = {}
    for name in categories:
        rows, own = maps.get(name, []), places.get(name)
        cell = best_cell(rows)
        parts = [
            _passes(rows, () if own is None or own.located is None else own.located),
            _read(run, "" if own is None else str(own)),
            _best_site(run, results, name, rows, along.get(name, [])),
        ]
        if cell is not None and is_backbone_layer(cell):
            parts.append(f"steer at {cell.place} {cell.role} (--direction {ALONG})")
        found[name] = f"Which layer, {category_of(name).title}: {'; '.join(filter(None, parts))}."
    return found


def _passes(rows: Sequence[PatchEffect], located: Sequence[str]) -> str:
    if not any(row.role == ALL and is_backbone_layer(row) for row in rows):
        return "where the answer passes was not tested (--kind interchange)"
    passes = [place for place in located if place.partition(".")[0] == BACKBONE]
    return f"passes at {list_places(passes)}" if passes else "no layer of the backbone carries half of it"


def _read(run: RunReader, places: str) -> str:
    family = get_family(run.model)
    if family is None or not family.interventions.supports("kv"):
        return ""
    read = [part for part in places.split("; ") if part.startswith("read ") or KV_STREAM in part]
    return "; ".join(read) or "where it is read is open (--kind joint tests it)"


def _best_site(
    run: RunReader,
    results: "ProbeResults | None",
    category: str,
    rows: Sequence[PatchEffect],
    along: Sequence[PatchEffect],
) -> str:
    if results is None:
        return "no probes are stored"
    view, scores = results.settings.views[0], results.scores
    own = scores[(scores["stream"] == BACKBONE) & (scores["view"] == view) & (scores["category"] == category)]
    if own.empty:
        return ""
    best = own.loc[own["accuracy"].idxmax()]
    place = f"{BACKBONE}.{int(best['layer']):02d}"
    signal = "" if best["signal"] else " (no signal)"
    return f"the probes' best site {place}{signal} {_in_words(run, place, view, rows, along)}"


def _in_words(
    run: RunReader, place: str, view: str, rows: Sequence[PatchEffect], along: Sequence[PatchEffect]
) -> str:
    family, role = get_family(run.model), role_of_view(view)
    if family is not None and unread_places([place], run.streams, family.interventions):
        return "is unread: nothing that acts reads the end of the backbone"
    whole = next((row for row in rows if (row.place, row.role) == (place, role)), None)
    inside = [row for row in along if (row.place, row.role) == (place, role) and not row.is_control]
    tie = tie_at_site(whole, inside, [row for row in rows if row.place == place])
    if tie == "not tested" and whole is not None and whole.is_localised:
        return "carries the effect; --direction mean-difference tests what probes read there"
    return _TIES[tie]
