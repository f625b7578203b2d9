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
    from probe_kit.intervene.pairs import Pair
    from probe_kit.intervene.patching.attribution import Screen, attribute_cells
    from probe_kit.intervene.patching.inference import HookPoint, run_with_cache, run_with_hooks
    from probe_kit.intervene.patching.patch import Cell, all_but, find_cells, patch_cells
    from probe_kit.intervene.patching.patterns import AttentionPattern, attention_patterns
    from probe_kit.intervene.patching.sets import MinimalCells, compare_alone_and_without, find_minimal_cells
    from probe_kit.intervene.patching.sweep import Sweep, sweep_cells
    from probe_kit.intervene.sessions.opening import find_pairs, open_session

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
        "AttentionPattern": "patterns",
        "Cell": "patch",
        "HookPoint": "inference",
        "MinimalCells": "sets",
        "Pair": "probe_kit.intervene.pairs",
        "Screen": "attribution",
        "Sweep": "sweep",
        "all_but": "patch",
        "attention_patterns": "patterns",
        "attribute_cells": "attribution",
        "compare_alone_and_without": "sets",
        "find_cells": "patch",
        "find_minimal_cells": "sets",
        "find_pairs": "probe_kit.intervene.sessions.opening",
        "logit_lens": "probe_kit.hooks.capturing.readouts",
        "open_session": "probe_kit.intervene.sessions.opening",
        "patch_cells": "patch",
        "project_heads": "probe_kit.hooks.capturing.readouts",
        "run_with_cache": "inference",
        "run_with_hooks": "inference",
        "sweep_cells": "sweep",
    },
)
