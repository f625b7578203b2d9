"""Default targets of a closed loop: the places that stored interchanges localised."""

from collections.abc import Sequence
from typing import Any

from probe_kit.errors import UsageError
from probe_kit.intervene.edits.sites import ALL
from probe_kit.intervene.kinds.base import ConditionName
from probe_kit.intervene.kinds.closed_loop.intervention import ClosedLoop
from probe_kit.intervene.kinds.interchange.intervention import NONE
from probe_kit.intervene.kinds.site_effects import PatchEffect
from probe_kit.intervene.results.site_maps import is_backbone_layer, stored_site_effects
from probe_kit.intervene.store.settings import InterventionSettings
from probe_kit.runs.run import Run
from probe_kit.train.data.run_reader import RunReader


def best_patch_targets(run: RunReader, categories: Sequence[str]) -> tuple[str, ...]:
    """`PLACE|ROLE`, of each category the last place of the backbone that was located, in its narrowest role.

    The last one is behind everything else through which the answer passes; where none of the backbone was located,
    the last of the acting stream or of `kv`. Of its roles the one with the largest effect, and all tokens only
    where no single role carries half of it. Raises UsageError if none was located.
    """
    stored = stored_site_effects(run)
    found = [best_cell(stored.get(category, [])) for category in categories]
    cells = tuple(dict.fromkeys(str(ConditionName(cell.place, cell.role)) for cell in found if cell is not None))
    if not cells:
        raise UsageError(
            f"no stored interchange of {run.location} located a place of {', '.join(categories)}: run "
            "`probe-kit intervene RUN --kind interchange` first, or name --sites and --roles"
        )
    return cells


def best_cell(rows: Sequence[PatchEffect]) -> PatchEffect | None:
    """The patch behind which nothing of the answer passes, of one category; see `best_patch_targets`."""
    located = [row for row in rows if row.is_localised and not row.direction]
    if not located:
        return None
    deepest = ([row for row in located if is_backbone_layer(row)] or located)[-1]
    last = [row for row in located if row.place == deepest.place]
    return max(last, key=lambda row: (row.role != ALL, row.effect or 0.0))


def build_closed_loop(run: Run, **options: Any) -> ClosedLoop:
    """At the named sites and roles, else at `best_patch_targets`. Raises UsageError for roles without sites."""
    sites, roles = options.pop("sites", None), options.pop("roles", None)
    if roles and not sites:
        raise UsageError("--roles of a closed loop go with --sites; leave both out for the best stored place")
    if options.get("direction") == NONE:
        options.setdefault("controls", 0)
    if sites:
        targets = tuple(str(ConditionName(site, role)) for site in sites for role in roles or (ALL,))
    else:
        categories = InterventionSettings(categories=options.get("categories")).categories_in(run)
        targets = best_patch_targets(run, categories)
    return ClosedLoop(**options, targets=targets)
