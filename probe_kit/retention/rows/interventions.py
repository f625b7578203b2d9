"""What stored interventions add to a row: does the action follow the pictures, and is what can be read used?

Reads what `probe-kit intervene` left in the run; no model is loaded.
"""

from collections.abc import Mapping
from dataclasses import replace
from math import isfinite

from probe_kit.intervene.kinds.image_swap import ImageSwapEffect
from probe_kit.intervene.results.verdict import Places, UseVerdict, classify_use, control_for
from probe_kit.retention.rows.parts import SwapEffect
from probe_kit.retention.rows.row import RetentionRow


def add_image_swap(
    row: RetentionRow,
    found: Mapping[str, ImageSwapEffect],
    places: Mapping[str, Places],
    tie: str = "",
    other: UseVerdict | None = None,
) -> RetentionRow:
    """The row with the effect of the image swap on its category, judged by its own probes.

    found: by category; may be empty. places: by category, where it passes and is read. tie: of the row's category
    and view, see `intervene.results.ties`. other: the behaviour by the other readout, see
    `intervene.results.readouts`.
    """
    own = found.get(row.category)
    if own is None:
        return row
    encoded = row.backbone.has_signal if row.backbone.exceeds else None
    category, control = row.category, control_for(row.category, found)
    use = classify_use(encoded, own, control, places.get(category), tie, other)
    effect = SwapEffect(
        follow_rate=own.follow_rate,
        reversal_rate=own.reversal_rate,
        net_follow_rate=own.net_follow_rate,
        net_follow_rate_ci=own.net_follow_rate_ci,
        reach_share=own.reach_share,
        reach_share_ci=own.reach_share_ci if isfinite(own.reach_share_ci[0]) else (None, None),
        follow_p=own.follow_p,
        use=use,
    )
    return replace(row, image_swap=effect)
