"""Activation patching as plain functions: capture, patch and compare, for one observation or for many pairs.

  from probe_kit import patching as pt
  pair = pt.Pair(clean, source, seed=0)
  cells = pt.find_cells(policy, "backbone.*|all,image", "kv.*|image", "backbone.02.heads.*|image")
  chunk = pt.patch_cells(policy, pair, cells[3])
  swept = pt.sweep_cells(policy, pairs, cells, metric)

Nothing is stored; `run_intervention` makes the same patches, stores them, and gives verdicts.
"""

from typing import TYPE_CHECKING

from probe_kit._system.imports import lazy_names

if TYPE_CHECKING:
    from probe_kit.hooks.capturing.readouts import logit_lens, project_heads
    from probe_kit.intervene.open_session import find_pairs, open_session
    from probe_kit.intervene.pairs import Pair
    from probe_kit.intervene.patching.attribution import Screen, attribute_cells
    from probe_kit.intervene.patching.patch import (
        AttentionPattern,
        Cell,
        HookPoint,
        all_but,
        attention_patterns,
        find_cells,
        patch_cells,
        run_with_cache,
        run_with_hooks,
    )
    from probe_kit.intervene.patching.sweep import (
        MinimalCells,
        Sweep,
        compare_alone_and_without,
        find_minimal_cells,
        sweep_cells,
    )

__all__ = [
    "AttentionPattern",
    "Cell",
    "HookPoint",
    "MinimalCells",
    "Pair",
    "Screen",
    "Sweep",
    "all_but",
    "attention_patterns",
    "attribute_cells",
    "compare_alone_and_without",
    "find_cells",
    "find_minimal_cells",
    "find_pairs",
    "logit_lens",
    "open_session",
    "patch_cells",
    "project_heads",
    "run_with_cache",
    "run_with_hooks",
    "sweep_cells",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "AttentionPattern": "patch",
        "Cell": "patch",
        "HookPoint": "patch",
        "MinimalCells": "sweep",
        "Pair": "probe_kit.intervene.pairs",
        "Screen": "attribution",
        "Sweep": "sweep",
        "all_but": "patch",
        "attention_patterns": "patch",
        "attribute_cells": "attribution",
        "compare_alone_and_without": "sweep",
        "find_cells": "patch",
        "find_minimal_cells": "sweep",
        "find_pairs": "probe_kit.intervene.open_session",
        "logit_lens": "probe_kit.hooks.capturing.readouts",
        "open_session": "probe_kit.intervene.open_session",
        "patch_cells": "patch",
        "project_heads": "probe_kit.hooks.capturing.readouts",
        "run_with_cache": "patch",
        "run_with_hooks": "patch",
        "sweep_cells": "sweep",
    },
)
