"""The places at which stored interventions found that the answer passes and is read; no model is needed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import starmap
from typing import TYPE_CHECKING, Literal

from probe_kit.hooks.contract.sites import KV_STREAM, role_of_view
from probe_kit.hooks.registry import get_family
from probe_kit.intervene.directions import DIRECTIONS, MEAN_DIFFERENCE
from probe_kit.intervene.exchange import NOTHING, carries_nothing
from probe_kit.intervene.kinds.image_swap import ImageSwapEffect, stored_image_swaps
from probe_kit.intervene.kinds.interchange import (
    BACKBONE,
    PatchEffect,
    best_cell,
    carrying_directions,
    is_backbone_layer,
    localised_by_category,
    stored_site_effects,
    stored_subspace_effects,
)
from probe_kit.intervene.kinds.joint import (
    EVERY,
    JointEffect,
    describe_joint_places,
    describe_remainders,
    is_read_jointly,
    stored_joint_places,
)
from probe_kit.intervene.patching.attribution import LOCALISATION_SHARE
from probe_kit.intervene.places import ALL, PlaceName, list_places, unread_places
from probe_kit.intervene.settings import FIRST_CHUNK, PER_STEP
from probe_kit.intervene.verdict import (
    Places,
    UseVerdict,
    classify_behaviour,
    classify_use,
    control_for,
    encoded_in,
)
from probe_kit.runs.reader import RunReader

if TYPE_CHECKING:
    from probe_kit.train.results.probe_results import ProbeResults


@dataclass(frozen=True)
class StoredEvidence:
    """All evidence of a run's stored interventions on the answer, by category; each part is computed once.

    Reading a part raises RunDamagedError if a stored intervention was changed.

    Attributes:
        run: Run with the stored interventions.
        classified: Image swaps that count, whatever else is stored of their categories.
    """

    run: RunReader
    classified: Sequence[ImageSwapEffect] = ()

    @cached_property
    def swaps(self) -> dict[str, ImageSwapEffect]:
        """The image swaps that are classified; empty if none is stored."""
        return {**stored_image_swaps(self.run), **{row.category: row for row in self.classified}}

    @cached_property
    def maps(self) -> dict[str, list[PatchEffect]]:
        """The effects of tokens patched in full."""
        return stored_site_effects(self.run)

    @cached_property
    def along(self) -> dict[str, list[PatchEffect]]:
        """The effects of patches within directions."""
        return stored_subspace_effects(self.run)

    @cached_property
    def joint(self) -> dict[str, list[JointEffect]]:
        """The effects of sets of places."""
        return stored_joint_places(self.run)

    @cached_property
    def places(self) -> dict[str, Places]:
        """The places of interchanges and joint searches; without categories that were not searched."""
        located, carried = localised_by_category(self.maps), carrying_directions(self.along)
        searched = {}
        for name, rows in self.joint.items():
            (every,) = (row for row in rows if row.part == EVERY)
            # A search of a part that carries nothing does not rule out the others.
            if every.finding != "past it" or every.cells == KV_STREAM:
                searched[name] = rows
        jointly = {name: describe_joint_places(rows) for name, rows in searched.items()}
        remainders = {name: describe_remainders(rows) for name, rows in searched.items()}
        return {
            name: Places(located.get(name), carried.get(name, ()), jointly.get(name, ""), remainders.get(name, ()))
            for name in dict.fromkeys((*located, *carried, *jointly))
        }

    @cached_property
    def other_readouts(self) -> dict[str, UseVerdict]:
        """The behaviour by the other readout; without categories in which that is not stored.

        The positive control is of the other readout too.
        """
        stored = {readout: stored_image_swaps(self.run, readout) for readout in (FIRST_CHUNK, PER_STEP)}
        verdicts: dict[str, UseVerdict] = {}
        for category, swap in self.swaps.items():
            same = stored[PER_STEP if swap.readout == FIRST_CHUNK else FIRST_CHUNK]
            if category in same:
                verdicts[category] = classify_behaviour(same[category], control_for(category, same))
        return verdicts

    def verdict(self, category: str, encoded: bool | None, tie: str = "") -> UseVerdict:
        """Return the verdict of a category whose images were swapped.

        Args:
            category: Category with an image swap.
            encoded: Whether the answer can be read in the backbone, see `classify_use`; None without probes.
            tie: Words of `describe_tie`; empty if the tie was not tested.
        """
        control, other = control_for(category, self.swaps), self.other_readouts.get(category)
        return classify_use(encoded, self.swaps[category], control, self.places.get(category), tie, other)

    def verdicts(self, results: "ProbeResults | None") -> dict[str, UseVerdict]:
        """Return every verdict, with the evidence of the first view of the newest probes."""
        encoded, ties = encoded_in(results), stored_ties(self, results)
        return {name: self.verdict(name, encoded.get(name), ties.get(name, "")) for name in self.swaps}


# The tie: is what probes read the thing that is used? Rules and words are those of `docs/causal.md`, *Tie*.
TieAtSite = Literal["read", "unread", "another code", "in part", "not tested"]
"""The tie of the readable copy to the behaviour at one site.

read: a subspace that probes find carries the effect. unread: the whole site carries nothing, and is no part of
several that are read together. another code: the site carries it, every such subspace nothing. in part: between,
or against the effect. not tested: no interchange there.
"""
OPEN = "whether the readable copy is the one used remains open"
UNPROBED = "probes find no copy beyond chance, but a linear direction carries it"
"""Words for the case that the items are too few for the probes.

The direction is fitted without the tested episode's groups.
"""
Sites = Mapping[tuple[str, str], TieAtSite]
"""The tie by place and role."""


def tie_at_site(
    full: PatchEffect | None, along: Sequence[PatchEffect], layer: Sequence[PatchEffect] = ()
) -> TieAtSite:
    """Return the tie at one place and role.

    Weights of a probe point away from all other variation, and may carry nothing of a copy that is read. So
    another code is found only where a direction of the class means carries nothing either.

    Args:
        full: Effect of the tokens there, patched in full; None if that was not tested.
        along: Effects of patches within subspaces there, without controls.
        layer: Effects of the same place at every role. A role that carries nothing alone can be one of several
            parts that decide together. It is unread if all tokens of the layer carry nothing either, or another
            role carries the effect.
    """
    if any(map(_is_read_along, along)):
        return "read"
    if full is None or full.effect_ci is None:
        return "not tested"
    if carries_nothing(*full.effect_ci):
        other_roles = [row for row in layer if row.role not in (ALL, full.role)]
        if full.role == ALL or any(row.is_localised for row in other_roles):
            return "unread"
        every_token = next((row.effect_ci for row in layer if row.role == ALL and row.effect_ci is not None), None)
        return "not tested" if every_token is None else "unread" if carries_nothing(*every_token) else "in part"
    tested = [row.effect_ci for row in along if row.effect_ci is not None]
    if tested and not all(starmap(carries_nothing, tested)):
        return "in part"
    if not tested or not any(row.direction.startswith(MEAN_DIFFERENCE) for row in along):
        return "not tested"
    carries = full.effect is not None and full.effect >= LOCALISATION_SHARE
    return "another code" if carries else "in part"


def _is_read_along(row: PatchEffect) -> bool:
    """Whether a direction carries the effect, beyond its controls."""
    is_beyond = row.effect_ci is not None and row.effect_ci[0] > NOTHING
    return row.is_localised and row.control_displacement is not None and is_beyond


def _tie(rows: Sequence[PatchEffect], along: Sequence[PatchEffect], site: str, role: str) -> TieAtSite:
    """Return `tie_at_site` of one place and role, from the effects of one category."""
    full = next((row for row in rows if (row.sites, row.role) == (site, role)), None)
    within = [row for row in along if (row.sites, row.role) == (site, role) and not row.is_control]
    return tie_at_site(full, within, [row for row in rows if row.sites == site])


def describe_tie(sites: Sites, is_joint: bool = False) -> str:
    """Return the tie of all sites together, in words; empty if it was not tested at enough of them.

    Args:
        sites: Tie by place and role.
        is_joint: Whether joint places found that the answer is read at several places together. A site that
            carries nothing alone can then be one of them.
    """
    at = {
        tie: [f"{site} {role}" for (site, role), site_tie in sites.items() if site_tie == tie]
        for tie in sites.values()
    }
    if "read" in at:
        return f"the readable copy is read ({list_places(at['read'])})"
    if not sites or "not tested" in at:
        return ""
    if "in part" in at or (is_joint and "unread" in at):
        return OPEN
    if "another code" in at:
        return f"the readable copy is not the one used: another code in the same place ({at['another code'][0]})"
    return "the readable copy is not the one used: the answer passes elsewhere"


def stored_ties(
    evidence: StoredEvidence, results: "ProbeResults | None", view: str | None = None
) -> dict[str, str]:
    """Return by category `describe_tie` of the sites at which probes of a view are significant.

    Sites at which a direction of the same means carries the effect count as well: it is fitted on other episodes.
    The first layer counts only where a direction was patched, because its tokens carry the effect by construction.
    Empty without probes, and for views that are no mean over a role.

    Args:
        evidence: Evidence of the run.
        results: Probes of the run; None without any.
        view: View of the probes; None for the first that was probed.
    """
    if results is None or (role := role_of_view(view or results.settings.views[0])) is None:
        return {}
    scores = results.scores
    in_view = (scores["stream"] == BACKBONE) & (scores["view"] == (view or results.settings.views[0]))
    ties = {}
    for category, rows in scores[in_view].groupby("category", sort=False):
        name = str(category)
        patched = evidence.maps.get(name, ())
        along = [  # one of a file need not be the answer's
            row
            for row in evidence.along.get(name, ())
            if row.is_control or row.direction in DIRECTIONS or row.direction.startswith(f"{MEAN_DIFFERENCE}:")
        ]
        significant = [f"{BACKBONE}.{int(layer):02d}" for layer in rows.loc[rows["signal"], "layer"]]
        # A direction of the mean over a role's tokens that carries the effect.
        is_pooled = [_is_read_along(row) and ":" not in row.direction and is_backbone_layer(row) for row in along]
        pooled = [row.sites for row, is_mean in zip(along, is_pooled, strict=True) if is_mean and row.role == role]
        if pooled and not significant:
            ties[name] = f"{UNPROBED} ({list_places([f'{site} {role}' for site in pooled])})"
            continue
        sites = {(site, role): _tie(patched, along, site, role) for site in sorted({*significant, *pooled})}
        inside = {at: tie for at, tie in sites.items() if tie != "not tested" or PlaceName.parse(at[0]).layer}
        ties[name] = describe_tie(inside, is_read_jointly(evidence.joint.get(name, ())))
    return ties


ALONG = f"{MEAN_DIFFERENCE}:1"
"""Direction that moves an answer that is in every token alike, and one that lies in which tokens are marked."""
_TIES: dict[TieAtSite, str] = {
    "read": "is read",
    "unread": "is unread",
    "another code": "holds another code than the one that is used",
    "in part": "carries a part of the effect",
    "not tested": "was not patched",
}


def which_layer(
    evidence: StoredEvidence, results: "ProbeResults | None", categories: Sequence[str]
) -> dict[str, list[str]]:
    """Return by category where the answer passes and where to steer, and, as later parts, what else is known.

    The later parts say where it is read, and whether the probes' best site is read. For interchanges and joint
    places that are not stored, the command that tests them is named.

    Args:
        evidence: Evidence of the run.
        results: The newest probes; None without any.
        categories: Categories to describe.
    """
    family = get_family(evidence.run.model)
    has_kv = family is not None and family.abilities.interventions.supports("kv")
    lines = {}
    for name in categories:
        rows, category_places = evidence.maps.get(name, []), evidence.places.get(name) or Places()
        passes, cell = "--kind interchange tests where the answer passes", best_cell(rows)
        if any(row.role == ALL and is_backbone_layer(row) for row in rows):
            located = [site for site in category_places.located or () if site.partition(".")[0] == BACKBONE]
            none = "no layer of the backbone carries half of it"
            passes = f"passes at {list_places(located)}" if located else none
        if cell is not None and is_backbone_layer(cell):
            passes += f"; steer at {cell.sites} {cell.role} with --direction {ALONG}"
        read = [part for part in category_places.parts if part.startswith("read ") or KV_STREAM in part]
        reads = ("; ".join(read) or "--kind joint tests where it is read") * has_kv
        best = _best_site(evidence.run, results, name, rows, evidence.along.get(name, []))
        lines[name] = [part for part in (passes, reads, best) if part]
    return lines


def _best_site(
    run: RunReader,
    results: "ProbeResults | None",
    category: str,
    rows: Sequence[PatchEffect],
    along: Sequence[PatchEffect],
) -> str:
    if results is None:
        return "no probes are stored: probe-kit train makes them"
    view, scores = results.settings.views[0], results.scores
    site_scores = scores[
        (scores["stream"] == BACKBONE) & (scores["view"] == view) & (scores["category"] == category)
    ]
    if site_scores.empty:
        return ""
    best = site_scores.loc[site_scores["accuracy"].idxmax()]
    site, family = f"{BACKBONE}.{int(best['layer']):02d}", get_family(run.model)
    tie, role = "", role_of_view(view)
    if family is not None and unread_places([site], run.streams, family.abilities.interventions):
        tie = "is unread: nothing that acts reads the end of the backbone"
    else:
        at_site = _tie(rows, along, site, role or "")
        tie = _TIES[at_site]
        carries = any((row.sites, row.role) == (site, role) and row.is_localised for row in rows)
        if at_site == "not tested" and carries:
            tie = "carries the effect; --direction mean-difference tests whether what probes read is used there"
    return f"the probes' best site {site}{'' if best['signal'] else ' (no signal)'} {tie}"
