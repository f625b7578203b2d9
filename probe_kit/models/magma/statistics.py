"""The units of Magma's actions, which the evaluation client holds in its code instead of the checkpoint."""

import json
from importlib.resources import files
from typing import Any


def shipped_statistics() -> dict[str, Any]:
    """Per data set, the quantiles that un-normalise its actions; `statistics.json` names their source."""
    text = (files("probe_kit.models.magma") / "statistics.json").read_text(encoding="utf-8")
    return dict(json.loads(text)["norm_stats"])
