"""The part of a row that interventions give: does the action follow the pictures, and is what can be read used?

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
    effects: Mapping[str, ImageSwapEffect],
    places: Mapping[str, Places],
    tie: str = "",
    other: UseVerdict | None = None,
) -> RetentionRow:
    """The row with the effect of the image swap on its category, judged by its own probes.

    effects: by category; may be empty. places: by category, where it passes and is read. tie: of the row's
    category and view, see `evidence.stored_ties`. other: the behaviour by the other readout, see
    `evidence.stored_other_readouts`.
    """
    of_category = effects.get(row.category)
    if of_category is None:
        return row
    encoded = row.backbone.has_signal if row.backbone.exceeds else None
    category, control = row.category, control_for(row.category, effects)
    use = classify_use(encoded, of_category, control, places.get(category), tie, other)
    effect = SwapEffect(
        follow_rate=of_category.follow_rate,
        reversal_rate=of_category.reversal_rate,
        net_follow_rate=of_category.net_follow_rate,
        net_follow_rate_ci=of_category.net_follow_rate_ci,
        reach_share=of_category.reach_share,
        reach_share_ci=of_category.reach_share_ci if isfinite(of_category.reach_share_ci[0]) else (None, None),
        follow_p=of_category.follow_p,
        use=use,
    )
    return replace(row, image_swap=effect)
