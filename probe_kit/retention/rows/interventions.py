"""What stored interventions add to a row: does the action follow the pictures, and is what can be read used?

Reads what `probe-kit intervene` left in the run; no model is loaded.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from probe_kit.intervene.kinds.image_swap.effects import Following
from probe_kit.intervene.kinds.image_swap.verdict import control_for, judge
from probe_kit.retention.rows.parts import SwapEffect
from probe_kit.retention.rows.row import RetentionRow


def add_image_swap(
    row: RetentionRow,
    found: Mapping[str, Following],
    located: Mapping[str, Sequence[str]],
    carried: Mapping[str, Sequence[str]],
) -> RetentionRow:
    """The row with the effect of the image swap on its category, judged by its own probes.

    found: by category; may be empty. located: places that carry it, by category, of those that were searched.
    carried: directions that do.
    """
    own = found.get(row.category)
    if own is None:
        return row
    encoded = row.backbone.signal if row.backbone.exceeds else None
    category, control = row.category, control_for(row.category, found)
    judged = judge(encoded, own, control, located.get(category), carried.get(category, ()))
    effect = SwapEffect(
        follows=own.follows,
        against=own.against,
        follows_net=own.net,
        follows_net_ci=own.net_ci,
        follows_p=own.p_follows,
        used=judged.verdict,
        used_note=judged.reason,
    )
    return replace(row, image_swap=effect)
