"""Where a closed loop changes an episode if no place is named: the places that stored interchanges located."""

from collections.abc import Sequence

from probe_kit.errors import UsageError
from probe_kit.intervene.edits.sites import ALL
from probe_kit.intervene.kinds.closed_loop.intervention import CELL
from probe_kit.intervene.kinds.site_effects import PatchEffect
from probe_kit.intervene.results.site_maps import BACKBONE, stored_site_effects
from probe_kit.train.data.run_reader import RunReader


def best_patch_targets(run: RunReader, categories: Sequence[str]) -> tuple[str, ...]:
    """`PLACE|ROLE`, of each category the last place of the backbone that was located, in its narrowest role.

    The last one is behind everything else through which the answer passes; where none of the backbone was located,
    the last of what acts or of the memory. Of its roles the one with the largest effect, and all tokens only where
    no single role carries half of it. Raises UsageError if none was located.
    """
    stored = stored_site_effects(run)
    found = [_best(stored.get(category, [])) for category in categories]
    cells = tuple(dict.fromkeys(cell for cell in found if cell is not None))
    if not cells:
        raise UsageError(
            f"no stored interchange of {run.location} located a place of {', '.join(categories)}: run "
            "`probe-kit intervene RUN --kind interchange` first, or name --sites and --roles"
        )
    return cells


def _best(rows: Sequence[PatchEffect]) -> str | None:
    located = [row for row in rows if row.is_localised and not row.direction]
    if not located:
        return None
    deepest = ([row for row in located if row.place.startswith(f"{BACKBONE}.")] or located)[-1]
    last = [row for row in located if row.place == deepest.place]
    best = max(last, key=lambda row: (row.role != ALL, row.effect or 0.0))
    return f"{best.place}{CELL}{best.role}"
