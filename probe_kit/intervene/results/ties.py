"""Ties: is the copy of the answer that probes read the one that the action uses? Reads what is stored.

Asked at every site at which a probe is significant, not at the best one alone: behind the place where a copy is
read there are others that nothing reads.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Literal

from probe_kit.intervene.edits.sites import ALL
from probe_kit.intervene.kinds.joint.effects import is_read_jointly, stored_joint_places
from probe_kit.intervene.kinds.site_effects import LOCALISATION_SHARE, PatchEffect
from probe_kit.intervene.results.site_maps import BACKBONE, stored_site_effects, stored_subspace_effects
from probe_kit.train.data.run_reader import RunReader

if TYPE_CHECKING:
    from probe_kit.train.results.probe_results import ProbeResults

TieAtSite = Literal["read", "unread", "another code", "in part", "not tested"]
"""read: a subspace that probes find carries the effect. unread: the whole site carries nothing, and is no part
of several that are read together. another code: the site carries it, every such subspace nothing. in part:
between. not tested: no interchange there."""
OPEN = "whether the readable copy is the one used remains open"
NOTHING = 0.1
"""Share of the swap's displacement below which an interval says that nothing is carried."""
Sites = Mapping[tuple[str, str], TieAtSite]
"""By place and role."""


def tie_at_site(
    whole: PatchEffect | None, along: Sequence[PatchEffect], layer: Sequence[PatchEffect] = ()
) -> TieAtSite:
    """The tie at one place and role. whole: its tokens patched in full. along: within subspaces, no controls.

    layer: the same place at every role. A role that carries nothing alone can be one of several parts that decide
    together. It is unread if all tokens of the layer carry nothing either, or another role carries the effect.
    """
    if any(row.is_localised and row.control_displacement is not None and _low(row) > NOTHING for row in along):
        return "read"
    if whole is None or whole.effect_ci is None:
        return "not tested"
    if whole.effect_ci[1] < NOTHING:
        return "unread" if whole.role == ALL else _without_others(whole, layer)
    tested = [row.effect_ci for row in along if row.effect_ci is not None]
    if not tested:
        return "not tested"
    carries = whole.effect is not None and whole.effect >= LOCALISATION_SHARE
    return "another code" if carries and all(high < NOTHING for _, high in tested) else "in part"


def _without_others(whole: PatchEffect, layer: Sequence[PatchEffect]) -> TieAtSite:
    """The tie of a role that carries nothing alone."""
    if any(row.is_localised and row.role not in (ALL, whole.role) for row in layer):
        return "unread"
    every = next((row for row in layer if row.role == ALL and row.effect_ci is not None), None)
    if every is None or every.effect_ci is None:
        return "not tested"
    return "unread" if every.effect_ci[1] < NOTHING else "in part"


def describe_tie(sites: Sites, is_joint: bool = False) -> str:
    """The tie of all sites together, in words; empty if that was not tested at enough of them.

    is_joint: whether joint places found that the answer is read at several places together. What carries nothing
    alone can then be one of them.
    """
    at = {tie: [f"{place} {role}" for (place, role), own in sites.items() if own == tie] for tie in sites.values()}
    if "read" in at:
        return f"the readable copy is read ({', '.join(at['read'])})"
    if not sites or "not tested" in at:
        return ""
    if "in part" in at or (is_joint and "unread" in at):
        return OPEN
    if "another code" in at:
        return f"the readable copy is not the one used: another code in the same place ({at['another code'][0]})"
    return "the readable copy is not the one used: the answer passes elsewhere"


def stored_ties(run: RunReader, results: "ProbeResults | None", view: str | None = None) -> dict[str, str]:
    """By category `describe_tie` of the sites at which probes of a view are significant.

    view: None for the first that was probed. Empty without probes, and for views that are no mean over a role.
    """
    role = None if results is None else _role_of(view or results.settings.views[0])
    if results is None or role is None:
        return {}
    scores = results.scores
    own = scores[(scores["stream"] == BACKBONE) & (scores["view"] == (view or results.settings.views[0]))]
    whole, along = stored_site_effects(run), stored_subspace_effects(run)
    jointly = stored_joint_places(run)
    found = {}
    for category, rows in own[own["signal"]].groupby("category", sort=False):
        name = str(category)
        places = [f"{BACKBONE}.{int(layer):02d}" for layer in dict.fromkeys(rows["layer"])]
        patched, within = whole.get(name, ()), along.get(name, ())
        sites = {
            (place, role): tie_at_site(
                next(iter(_at(patched, place, role)), None),
                [row for row in _at(within, place, role) if not row.is_control],
                [row for row in patched if row.place == place],
            )
            for place in places
        }
        found[name] = describe_tie(sites, is_read_jointly(jointly.get(name, ())))
    return found


def _role_of(view: str) -> str | None:
    """The role whose tokens a view averages: all of them for `mean`."""
    kind, _, role = view.partition(":")
    return (role or ALL) if kind == "mean" else None


def _at(rows: Iterable[PatchEffect], place: str, role: str) -> list[PatchEffect]:
    return [row for row in rows if (row.place, row.role) == (place, role)]


def _low(row: PatchEffect) -> float:
    return -1.0 if row.effect_ci is None else row.effect_ci[0]
