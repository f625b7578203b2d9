"""Ties: is the copy of the answer that probes read the one that the action uses? Reads what is stored.

Asked at every site at which a probe is significant, not at the best one alone: behind the place where a copy is
read there are others that nothing reads.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import starmap
from typing import TYPE_CHECKING, Literal

from probe_kit.intervene.edits.pooled_directions import MEAN_DIFFERENCE
from probe_kit.intervene.edits.sites import ALL, list_places
from probe_kit.intervene.kinds.joint.effects import NOTHING, carries_nothing, is_read_jointly, stored_joint_places
from probe_kit.intervene.kinds.site_effects import LOCALISATION_SHARE, PatchEffect
from probe_kit.intervene.results.site_maps import (
    BACKBONE,
    is_backbone_layer,
    is_upstream,
    stored_site_effects,
    stored_subspace_effects,
)
from probe_kit.train.data.run_reader import RunReader

if TYPE_CHECKING:
    from probe_kit.train.results.probe_results import ProbeResults

TieAtSite = Literal["read", "unread", "another code", "in part", "not tested"]
"""read: a subspace that probes find carries the effect. unread: the whole site carries nothing, and is no part
of several that are read together. another code: the site carries it, every such subspace nothing. in part:
between, or against the effect. not tested: no interchange there."""
OPEN = "whether the readable copy is the one used remains open"
UNPROBED = "probes find no copy beyond chance, but a linear direction carries it"
"""Where the items are too few for the probes. The direction is fitted without the tested episode's groups."""
Sites = Mapping[tuple[str, str], TieAtSite]
"""By place and role."""


def tie_at_site(
    whole: PatchEffect | None, along: Sequence[PatchEffect], layer: Sequence[PatchEffect] = ()
) -> TieAtSite:
    """The tie at one place and role. whole: its tokens patched in full. along: within subspaces, no controls.

    Weights of a probe point away from what else varies, and may carry nothing of a copy that is read. That it is
    another code is said only where a direction of the class means carries nothing either.

    layer: the same place at every role. A role that carries nothing alone can be one of several parts that decide
    together. It is unread if all tokens of the layer carry nothing either, or another role carries the effect.
    """
    if any(map(_is_read_along, along)):
        return "read"
    if whole is None or whole.effect_ci is None:
        return "not tested"
    if carries_nothing(*whole.effect_ci):
        return "unread" if whole.role == ALL else _without_others(whole, layer)
    tested = [row.effect_ci for row in along if row.effect_ci is not None]
    if not tested:
        return "not tested"
    if not all(starmap(carries_nothing, tested)):
        return "in part"
    if not any(row.direction.startswith(MEAN_DIFFERENCE) for row in along):
        return "not tested"
    carries = whole.effect is not None and whole.effect >= LOCALISATION_SHARE
    return "another code" if carries else "in part"


def _without_others(whole: PatchEffect, layer: Sequence[PatchEffect]) -> TieAtSite:
    """The tie of a role that carries nothing alone."""
    if any(row.is_localised and row.role not in (ALL, whole.role) for row in layer):
        return "unread"
    every = next((row for row in layer if row.role == ALL and row.effect_ci is not None), None)
    if every is None or every.effect_ci is None:
        return "not tested"
    return "unread" if carries_nothing(*every.effect_ci) else "in part"


def describe_tie(sites: Sites, is_joint: bool = False) -> str:
    """The tie of all sites together, in words; empty if that was not tested at enough of them.

    is_joint: whether joint places found that the answer is read at several places together. What carries nothing
    alone can then be one of them.
    """
    at = {tie: [f"{place} {role}" for (place, role), own in sites.items() if own == tie] for tie in sites.values()}
    if "read" in at:
        return f"the readable copy is read ({list_places(at['read'])})"
    if not sites or "not tested" in at:
        return ""
    if "in part" in at or (is_joint and "unread" in at):
        return OPEN
    if "another code" in at:
        return f"the readable copy is not the one used: another code in the same place ({at['another code'][0]})"
    return "the readable copy is not the one used: the answer passes elsewhere"


def stored_ties(run: RunReader, results: "ProbeResults | None", view: str | None = None) -> dict[str, str]:
    """By category `describe_tie` of the sites at which probes of a view are significant.

    So are sites at which a direction of the same means carries the effect: it is read out of other episodes. The
    first layer counts only where a direction was patched, because its tokens carry the effect by construction.

    view: None for the first that was probed. Empty without probes, and for views that are no mean over a role.
    """
    role = None if results is None else role_of_view(view or results.settings.views[0])
    if results is None or role is None:
        return {}
    scores = results.scores
    own = scores[(scores["stream"] == BACKBONE) & (scores["view"] == (view or results.settings.views[0]))]
    whole, along = stored_site_effects(run), stored_subspace_effects(run)
    jointly = stored_joint_places(run)
    found = {}
    for category, rows in own.groupby("category", sort=False):
        name = str(category)
        patched, within = whole.get(name, ()), along.get(name, ())
        significant = [f"{BACKBONE}.{int(layer):02d}" for layer in rows.loc[rows["signal"], "layer"]]
        pooled = [row.place for row in within if row.role == role and _is_pooled_carrier(row)]
        if pooled and not significant:
            found[name] = f"{UNPROBED} ({list_places([f'{place} {role}' for place in pooled])})"
            continue
        places = sorted({*significant, *pooled})
        sites = {
            (place, role): tie_at_site(
                next(iter(_at(patched, place, role)), None),
                [row for row in _at(within, place, role) if not row.is_control],
                [row for row in patched if row.place == place],
            )
            for place in places
        }
        inside = {at: tie for at, tie in sites.items() if tie != "not tested" or not is_upstream(at[0])}
        found[name] = describe_tie(inside, is_read_jointly(jointly.get(name, ())))
    return found


def _is_pooled_carrier(row: PatchEffect) -> bool:
    """Whether a direction of the mean over a role's tokens carries the effect, beyond its controls."""
    return _is_read_along(row) and ":" not in row.direction and is_backbone_layer(row)


def _is_read_along(row: PatchEffect) -> bool:
    return row.is_localised and row.control_displacement is not None and _low(row) > NOTHING


def role_of_view(view: str) -> str | None:
    """The role whose tokens a view averages, all of them for `mean`; None for another view."""
    kind, _, role = view.partition(":")
    return (role or ALL) if kind == "mean" else None


def _at(rows: Iterable[PatchEffect], place: str, role: str) -> list[PatchEffect]:
    return [row for row in rows if (row.place, row.role) == (place, role)]


def _low(row: PatchEffect) -> float:
    return -1.0 if row.effect_ci is None else row.effect_ci[0]
